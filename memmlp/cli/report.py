"""`memmlp report`: all tables and figures as one HTML page."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click

from memmlp.cli.options import outputs_option

if TYPE_CHECKING:
    from memmlp.report.html import Chapter

EVERY = ["all", "memory_control"]


@click.command("report")
@click.argument("words", nargs=-1, metavar="[NAMES]... [OVERRIDES]...")
@click.option(
    "--out",
    type=click.Path(path_type=Path, dir_okay=False),
    help="HTML file to write.  [default: report.html in --outputs]",
)
@outputs_option
def report(words: tuple[str, ...], out: Path | None, outputs: Path) -> None:
    """Write one page of tables, effects, accuracy against latency, training curves and runs.

    The page needs no network. NAMES are those of `memmlp table`; without any, it has all tables of the paper
    and the memory's controls. OVERRIDES are those that the sweeps were run with; they find the runs again.
    """
    from memmlp.cli.table import write
    from memmlp.config.packaged import packaged
    from memmlp.report.html import page as written
    from memmlp.report.html import published
    from memmlp.runs.environment import environment
    from memmlp.sweep.spec import load_sweep

    names = [word for word in words if "=" not in word and not word.startswith("~")] or EVERY
    chapters = chapters_of(names, [word for word in words if word not in names], outputs)
    folder = packaged("sweeps")
    systems = published(load_sweep(folder / "table01.yaml"), load_sweep(folder / "table17.yaml"))
    git = environment()["git"] or {}
    code = f"{git.get('commit', environment()['version'])[:7]}{' with changes' if git.get('dirty') else ''}"
    when = datetime.now(UTC).strftime("Generated %Y-%m-%d %H:%M UTC")
    write(out or outputs / "report.html", written(chapters, systems, when, code))


def chapters_of(names: Sequence[str], overrides: Sequence[str], outputs: Path) -> list[Chapter]:
    """Return the tables of some names with the finished runs behind them; each run is read once."""
    from memmlp.cli.table import SHOWN_MODES, gathered
    from memmlp.report.html import Chapter
    from memmlp.tables.measured_run import load

    found = gathered(names, overrides, outputs, SHOWN_MODES["both"], functools.cache(load))
    return [Chapter(sweep, table, runs) for sweep, runs, table in found]
