"""`memmlp loggers` and `memmlp mlflow`: run folders shown in MLflow, TensorBoard and W&B."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

import click

from memmlp.cli.options import outputs_option
from memmlp.common.errors import InputError

if TYPE_CHECKING:
    from memmlp.experiment_tracking.run_logger import RunLogger
    from memmlp.sweep.plan import Plan
    from memmlp.tables.table import Table

LOGGERS = ("mlflow", "tensorboard", "wandb")


@click.group("loggers")
def loggers() -> None:
    """Fill in what MLflow, TensorBoard or W&B lack of runs."""


@loggers.command("sync")
@click.option(
    "--logger",
    "names",
    multiple=True,
    type=click.Choice(LOGGERS),
    help="Which to bring up to date; may be repeated.  [default: mlflow]",
)
@click.option(
    "--uri",
    default=None,
    help="Address of MLflow's store.  [default: MLFLOW_TRACKING_URI, or else sqlite in OUTPUTS]",
)
@click.option("--project", default="memmlp", show_default=True, help="W&B's project.")
@click.option("--full", is_flag=True, help="Compare runs anew that were shown to their end before.")
@outputs_option
def sync(names: tuple[str, ...], uri: str | None, project: str, full: bool, outputs: Path) -> None:
    """Bring loggers up to date with all runs and sweeps.

    Afterwards they have exactly what the run folders have, each thing once; runs that are going on at present
    are left to the process that shows them. It may be repeated at any time.
    """
    from memmlp.common.progress import progress_bar
    from memmlp.experiment_tracking.sync import sync as fill_in
    from memmlp.experiment_tracking.sync import sync_sweeps
    from memmlp.runs.lookup import list_runs

    begun = [run for run in list_runs(outputs) if run.manifest]
    sweeps = sorted(path.parent for path in outputs.glob("sweeps/*/summary.json"))
    complaints: list[str] = []
    for logger in _loggers(names or ("mlflow",), uri, project, outputs):
        found = fill_in(logger, progress_bar(begun, logger.name), outputs, complaints.append, full)
        groups = sync_sweeps(logger, sweeps, complaints.append)
        live = f", {found['live']} are going on" if found["live"] else ""
        runs = f"{found['shown'] + found['same']} runs ({found['shown']} of them now)"
        click.echo(f"{runs} and {groups} sweeps are in {logger.place}{live}")
    for line in complaints:
        click.echo(f"memmlp: warning: {line}", err=True)
    if complaints:
        raise SystemExit(1)


def _loggers(names: Sequence[str], uri: str | None, project: str, outputs: Path) -> list[RunLogger]:
    """Return the loggers with these names. Raises InputError if a package is missing."""
    from memmlp.experiment_tracking.mlflow_logger import MLflow
    from memmlp.experiment_tracking.tensorboard_logger import TensorBoard
    from memmlp.experiment_tracking.wandb_logger import WandB

    every: dict[str, RunLogger] = {
        "mlflow": MLflow(uri, outputs),
        "tensorboard": TensorBoard(outputs),
        "wandb": WandB(project, outputs),
    }
    return [every[name] for name in dict.fromkeys(names)]


def show_in_loggers(plan: Plan, folder: Path, table: Table) -> None:
    """Write the sweep's summary into its folder, and show it in the loggers that show its runs."""
    from omegaconf import OmegaConf

    from memmlp.config.build import build_loggers
    from memmlp.tables.sweep_summary import write_summary

    write_summary(plan, table, folder)
    if plan.tasks:
        build_loggers(OmegaConf.create(dict(plan.tasks[0].config))).sweep(folder)


def mlflow_has_page() -> bool:
    """Return whether MLflow is installed with its page, which mlflow-skinny lacks."""
    try:
        metadata.version("mlflow")
    except metadata.PackageNotFoundError:
        return False
    return True


@click.command("mlflow")
@click.option("--port", default=5000, show_default=True)
@outputs_option
def mlflow(port: int, outputs: Path) -> None:
    """Open MLflow's page on the tracked runs (needs pip install 'memmlp[mlflow]')."""
    from memmlp.experiment_tracking.mlflow_logger import MLflow

    store = MLflow(None, outputs).place
    program = shutil.which("mlflow")
    if program is None or not mlflow_has_page():
        raise InputError("mlflow: its page is not installed; pip install 'memmlp[mlflow]'")
    os.execv(program, [program, "ui", "--backend-store-uri", store, "--port", str(port)])
