"""`memmlp table`: measured values beside those that the paper prints."""

from __future__ import annotations

import functools
import gc
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import click

from memmlp.cli.options import (
    config_dir_option,
    outputs_option,
    plugins_option,
    source_option,
    together_option,
)
from memmlp.common.errors import InputError
from memmlp.sweep.definition import BRANCHES

if TYPE_CHECKING:
    from memmlp.cli.shown_seeds import ShownSweep
    from memmlp.sweep.definition import Sweep
    from memmlp.tables.effects import RunsBySeed
    from memmlp.tables.runs_of_plan import Read
    from memmlp.tables.seeds_needed import Need
    from memmlp.tables.table import Table

SHOWN_MODES = {"stream": ("stream",), "window": ("window",), "both": ("stream", "window")}


@click.command("table")
@click.argument("name")
@click.argument("overrides", nargs=-1)
@click.option(
    "--format",
    "form",
    type=click.Choice(["md", "tex", "json", "html"]),
    help="Format to print in.  [default: a table for the screen]",
)
@click.option(
    "--out",
    type=click.Path(path_type=Path, dir_okay=False),
    help="File to write the table into; its ending tells the format.",
)
@click.option(
    "--mode",
    type=click.Choice(list(SHOWN_MODES)),
    default="both",
    show_default=True,
    help="Mode of evaluation whose errors are shown.",
)
@click.option(
    "--branch",
    type=click.Choice(BRANCHES),
    help="Branch whose errors are shown.  [default: that of the paper's table]",
)
@source_option
@together_option
@click.option(
    "--add",
    multiple=True,
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Show also what a browser measured: a file of the bench of memmlp web. For Table 17; repeatable.",
)
@click.option(
    "--untrained",
    is_flag=True,
    help="Measure networks without a run untrained; for tables of costs alone (16, 17).",
)
@click.option(
    "--seeds-needed",
    is_flag=True,
    help="Show how many seeds it would take to see the paper's effects on this data.",
)
@config_dir_option
@plugins_option
@outputs_option
def table(
    name: str,
    overrides: tuple[str, ...],
    form: str | None,
    out: Path | None,
    mode: str,
    branch: str | None,
    source: str | None,
    together: tuple[str, ...],
    add: tuple[Path, ...],
    untrained: bool,
    seeds_needed: bool,
    outputs: Path,
) -> None:
    """Show the table of a sweep: NAME is a file's path, a shipped sweep, a table's number, or `all`.

    OVERRIDES are those that the sweep was run with; they find its runs again.
    """
    from memmlp.tables import rows_measured_in_browsers
    from memmlp.tables.measured_run import load

    if seeds_needed and (form or out or add):
        raise InputError("--seeds-needed: goes to the screen alone, without --format, --out and --add")
    measured = [rows_measured_in_browsers.read(path) for path in add]
    selection = TableSelection(branch, source, together, untrained)
    with _uncollected():
        found = gathered([name], overrides, outputs, SHOWN_MODES[mode], functools.cache(load), selection)
    if seeds_needed:
        seeds_on_screen(found, SHOWN_MODES[mode])
        return
    tables = [functools.reduce(rows_measured_in_browsers.with_rows, measured, one.table) for one in found]
    if form is None and out is None:
        on_screen(tables)
        return
    text = _formatted(tables, form or _form_of(out), alone=name != "all")
    if out is None:
        click.echo(text, nl=False)
    else:
        write(out, text)


@contextmanager
def _uncollected() -> Iterator[None]:
    """Switch garbage collection off within the context.

    Everything that is read from the runs stays in use, so searching it for garbage would waste a second.
    """
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


class TableSelection(NamedTuple):
    """What of a sweep's results its table shows.

    Attributes:
        branch: the branch to show in place of the variants' own; None for the variants' own.
        source: the only source whose test clips are shown; None for all.
        together: patterns of test clips that count as one group, beside the groups of the data.
        untrained: whether to measure the costs of networks without a run, with random weights.
    """

    branch: str | None = None
    source: str | None = None
    together: Sequence[str] = ()
    untrained: bool = False


WHOLE = TableSelection()


class SweepTable(NamedTuple):
    """A sweep, the finished runs of its variants by seed, and its table."""

    sweep: Sweep
    runs: dict[str, RunsBySeed]
    table: Table


def gathered(
    names: Sequence[str],
    overrides: Sequence[str],
    outputs: Path,
    modes: Sequence[str],
    read: Read,
    selection: TableSelection = WHOLE,
) -> list[SweepTable]:
    """Gather the tables with the given names.

    A table of the paper whose config lacks something (such as the folder of AMASS) shows only the paper's
    values, and says so.

    Args:
        names: names of sweeps, as given to `memmlp table`.
        overrides: the command line's overrides.
        outputs: the folder of runs and caches.
        modes: modes of evaluation to show.
        read: reads a run (`memmlp.tables.measured_run.load`).
        selection: what of the results is shown.

    Raises:
        InputError: if none of them can be composed with the command line's overrides, or has that selection.
    """
    from memmlp.cli.shown_seeds import shown_sweep
    from memmlp.common.progress import progress_bar
    from memmlp.tables.build_table import without_runs

    found, failures = [], []
    sweeps = find_sweeps(names, overrides)
    for sweep, command in progress_bar(sweeps, "tables") if len(sweeps) > 1 else sweeps:
        sweep = sweep.with_branch(selection.branch) if selection.branch else sweep
        if selection.untrained:
            from memmlp.config.untrained_costs import check_costs

            check_costs(sweep)
        try:
            known = shown_sweep(sweep, overrides, outputs.absolute())
            found.append(table_of_plan(known, modes, command, read, selection))
        except InputError as error:
            failures.append(error)
            table = without_runs(sweep, modes, f"nothing measured: {error}")
            found.append(SweepTable(sweep, {variant.label: {} for variant in sweep.runnable()}, table))
    asked = overrides or selection.source or selection.together or found[0].sweep.table is None
    if failures and asked and len(failures) == len(found):
        raise failures[0]
    return found


def table_of_plan(
    shown: ShownSweep,
    modes: Sequence[str],
    command: str,
    read: Read,
    selection: TableSelection = WHOLE,
) -> SweepTable:
    """Return a planned sweep's finished runs, and the table of a part of their results."""
    from memmlp.tables.build_table import finished_runs, make_table, on_source, titled, together
    from memmlp.tables.runs_of_plan import older_run_finder, run_finder, state_finder

    sweep, plan, rounds, flags = shown
    for option, given in (("source", selection.source), ("together", " ".join(selection.together))):
        if given and rounds:
            raise InputError(
                f"--{option} {given}: allowed for a fixed number of seeds, not for --until-decided"
            )
    runs = finished_runs(sweep, run_finder(plan, read))
    if selection.untrained:
        from memmlp.config.untrained_costs import with_costs

        runs, measured = with_costs(sweep, runs)
        flags = (*flags, *measured)
    if selection.source:
        sweep, runs, left_out = on_source(sweep, runs, selection.source)
        flags = (*left_out, *flags)
    runs, tied = together(runs, selection.together)
    flags = (*tied, *flags)
    command = f"{command} --until-decided" if rounds else command
    table = make_table(sweep, runs, modes, command, state_finder(plan), older_run_finder(plan), rounds)
    table = titled(table, selection.source) if selection.source else table
    return SweepTable(sweep, runs, replace(table, flags=(*table.flags, *flags)))


def find_sweeps(names: Sequence[str], overrides: Sequence[str]) -> list[tuple[Sweep, str]]:
    """Find the sweeps with these names and overrides, and return each with the command that runs it."""
    from memmlp.config.compose_plan import find_sweep
    from memmlp.config.package_data import packaged
    from memmlp.config.plugins import config_dir_words

    tables = sorted(path.stem for path in packaged("sweeps").glob("table*.yaml"))
    every = [one for name in names for one in (tables if name == "all" else [name])]
    return [
        (find_sweep(one, overrides), " ".join(["memmlp sweep", one, *overrides, *config_dir_words()]))
        for one in every
    ]


def on_screen(tables: Sequence[Table]) -> None:
    """Print tables in the width of the screen."""
    from rich.console import Console

    from memmlp.tables.formats import show

    console = Console(highlight=False, markup=False)
    for one in tables:
        show(one, console)


def seeds_on_screen(found: Sequence[SweepTable], modes: Sequence[str]) -> None:
    """Print, sweep by sweep, how many seeds the paper's effects would need."""
    from memmlp.tables.seeds_needed import needs
    from memmlp.tables.table_text import caption

    for one in found:
        wanted = needs(one.sweep, one.runs, modes)
        click.echo(caption(one.table))
        if wanted:
            click.echo(_needed(wanted))
        else:
            click.echo(
                "no variant with an effect that the paper prints has two seeds and two groups of clips"
            )
        click.echo()


def _needed(wanted: Sequence[Need]) -> str:
    """Return a line for each comparison, and a note on how to read them."""
    rows = [("variant", "mode", "metric", "paper", "here", "seeds", "needed")]
    for need in wanted:
        differences = (f"{need.paper:+.2f}", f"{need.measured:+.2f}")
        number = "no number" if need.seeds is None else str(need.seeds)
        rows.append((need.label, need.mode, need.metric, *differences, str(need.have), number))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [
        "  ".join(
            word.ljust(width) if i < 3 else word.rjust(width)
            for i, (word, width) in enumerate(zip(row, widths, strict=True))
        )
        for row in rows
    ]
    note = (
        "needed: seeds for an effect of the paper's size to be significant with 80 % power, after Holm's "
        "correction over this table, with these test clips; no number: the clips alone are too uncertain"
    )
    return "\n".join([*lines, note])


def _formatted(tables: Sequence[Table], form: str, alone: bool) -> str:
    """Return the tables as one text; in JSON, it is a single object if `alone`, else a list."""
    from memmlp.tables.formats import FORMATS

    texts = [FORMATS[form](one) for one in tables]
    if form == "json" and not alone:
        return "[\n" + ",\n".join(text.rstrip() for text in texts) + "\n]\n"
    return "\n".join(texts)


def _form_of(out: Path | None) -> str:
    """Return the format for a file's suffix. Raises InputError for an unknown suffix."""
    from memmlp.tables.formats import FORMATS

    ending = out.suffix.removeprefix(".") if out else ""
    if ending not in FORMATS:
        raise InputError(f"--out {out}: allowed endings are {', '.join(FORMATS)}, or any with --format")
    return ending


def write(out: Path, text: str) -> None:
    """Write the file of --out and print its path. Raises InputError if it can't be written."""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"--out {out}: {error.strerror or error}") from None
    click.echo(str(out))
