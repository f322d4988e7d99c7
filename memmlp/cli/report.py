"""`memmlp report`: sweeps, their runs, all tables and figures as one HTML file."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import click

from memmlp.cli.options import config_dir_option, outputs_option, plugins_option

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
@click.option(
    "--tables-only", is_flag=True, help="The tables and figures alone: a small page that prints well."
)
@click.option("--no-replays", is_flag=True, help="Leave out the worst seconds of the best runs, in 3D.")
@config_dir_option
@plugins_option
@outputs_option
def report(
    words: tuple[str, ...], out: Path | None, tables_only: bool, no_replays: bool, outputs: Path
) -> None:
    """Write what `memmlp ui` shows of some sweeps as one file, with their tables and figures.

    The file needs no server and no network. NAMES are those of `memmlp table`; without any, it has all tables
    of the paper and the memory's controls. OVERRIDES are those that the sweeps were run with; they find the
    runs again. All searches below --outputs are in it, too.
    """
    from memmlp.cli.table import write
    from memmlp.config.package_data import packaged
    from memmlp.report.html import fragment, page, published
    from memmlp.runs.environment import environment
    from memmlp.sweep.sweep_file import load_sweep

    chosen = [word for word in words if "=" not in word and not word.startswith("~")]
    chapters = chapters_of(chosen or EVERY, [word for word in words if word not in chosen], outputs)
    if not chosen:
        chapters.sort(key=_lacking)
    folder = packaged("sweeps")
    systems = published(load_sweep(folder / "table01.yaml"), load_sweep(folder / "table17.yaml"))
    git = environment()["git"] or {}
    code = f"{git.get('commit', environment()['version'])[:7]}{' with changes' if git.get('dirty') else ''}"
    when = datetime.now(UTC).strftime("Generated %Y-%m-%d %H:%M UTC")
    if tables_only:
        text = page(chapters, systems, when, code)
    else:
        text = one_file(chapters, outputs, fragment(chapters, systems, when, code), not no_replays)
    write(out or outputs / "report.html", text)


def _lacking(chapter: Chapter) -> float:
    """Return the share of a table's arms that has no run: what a reader looks for first has most of them."""
    arms = chapter.sweep.runnable()
    return sum(not chapter.runs.get(arm.label) for arm in arms) / max(len(arms), 1)


def one_file(chapters: Sequence[Chapter], outputs: Path, extra: str, replays: bool) -> str:
    """Return the page of these sweeps as one file, with further HTML on a page of its own."""
    from memmlp.cli.ui import predict
    from memmlp.config.compose_plan import sweep_folder
    from memmlp.report.ui.one_file import ReportedSweep, page_text
    from memmlp.report.ui.routes import Answers

    answers = Answers(outputs, predict, kept=False)
    shown = [ReportedSweep(sweep_folder(one.sweep, outputs).name, one.table) for one in chapters]
    try:
        return page_text(answers, shown, extra, replays)
    finally:
        answers.close()


def chapters_of(names: Sequence[str], overrides: Sequence[str], outputs: Path) -> list[Chapter]:
    """Return the tables for some names, with the finished runs behind them; each run is read once."""
    from memmlp.cli.table import SHOWN_MODES, gathered
    from memmlp.report.html import Chapter
    from memmlp.tables.measured_run import load

    found = gathered(names, overrides, outputs, SHOWN_MODES["both"], functools.cache(load))
    return [Chapter(sweep, table, runs) for sweep, runs, table in found]
