"""`memmlp loggers`: show run folders in MLflow, TensorBoard and W&B."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import click

from memmlp.cli.options import outputs_option
from memmlp.common.components import find_component
from memmlp.common.progress import progress_bar
from memmlp.runs.lookup import list_runs

if TYPE_CHECKING:
    from memmlp.runs.loggers.logger import RunLogger

LOGGERS = ("mlflow", "tensorboard", "wandb")


@click.group("loggers")
def loggers() -> None:
    """Add runs to MLflow, TensorBoard or W&B."""


@loggers.command("sync")
@click.option(
    "--logger",
    "names",
    multiple=True,
    type=click.Choice(LOGGERS),
    help="Logger to update; repeatable.  [default: mlflow]",
)
@outputs_option
def sync(names: tuple[str, ...], outputs: Path) -> None:
    """Update loggers with all runs.

    Then the loggers show the same as the run folders, without duplicates. Runs in progress are skipped,
    because their own processes update the loggers. You can repeat the command at any time.
    """
    from memmlp.runs.loggers import logger as run_loggers

    started = [run for run in list_runs(outputs) if run.manifest]
    warnings: list[str] = []
    for logger in _make_loggers(names or ("mlflow",), outputs):
        counts = run_loggers.sync_runs(logger, progress_bar(started, logger.name), warnings.append)
        live = f", {counts['live']} are in progress" if counts["live"] else ""
        runs = f"{counts['shown'] + counts['same']} runs ({counts['shown']} updated now)"
        click.echo(f"{runs} are in {logger.place}{live}")
    for line in warnings:
        click.echo(f"memmlp: warning: {line}", err=True)
    if warnings:
        raise SystemExit(1)


def _make_loggers(names: Sequence[str], outputs: Path) -> list[RunLogger]:
    components = [find_component("loggers", name) for name in dict.fromkeys(names)]
    return [one.build(asdict(one.settings()), outputs=outputs) for one in components]
