"""`memmlp table`: show measured values beside the paper's values."""

from __future__ import annotations

import functools
import gc
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import click

from memmlp.cli.options import (
    HomePath,
    config_dir_option,
    outputs_option,
    plugins_option,
    source_option,
    together_option,
    weigh_groups_option,
)
from memmlp.common.errors import InputError
from memmlp.common.files import atomic_write
from memmlp.common.text_formats import join_command
from memmlp.sweep.definition import BRANCHES

if TYPE_CHECKING:
    from memmlp.report.tables.build_table import ReadRun
    from memmlp.report.tables.effects import RunsBySeed
    from memmlp.report.tables.seed_rounds import Rounds
    from memmlp.report.tables.table import Table
    from memmlp.sweep.definition import Sweep
    from memmlp.sweep.plan import Plan

SHOWN_MODES = {"stream": ("stream",), "window": ("window",), "both": ("stream", "window")}


@click.command("table")
@click.argument("name")
@click.argument("overrides", nargs=-1)
@click.option(
    "--format",
    "form",
    type=click.Choice(["md", "tex", "json"]),
    help="Output format.  [default: a table for the screen]",
)
@click.option("--out", type=HomePath(dir_okay=False), help="File to write; its suffix sets the format.")
@click.option(
    "--mode",
    type=click.Choice(list(SHOWN_MODES)),
    default="both",
    help="Evaluation mode of the errors to show.",
)
@click.option(
    "--branch",
    type=click.Choice(BRANCHES),
    help="Show errors of this branch: rotation, position or combined.  [default: as in the paper's table]",
)
@source_option
@together_option
@weigh_groups_option
@click.option(
    "--untrained",
    is_flag=True,
    help="Measure the costs of networks without a run, with random weights; only for Tables 16 and 17.",
)
@click.option(
    "--seeds-needed",
    is_flag=True,
    help="Show the number of seeds needed to detect the paper's effects with this data.",
)
@click.option(
    "--official",
    is_flag=True,
    help="Show the published value, that of the authors' weights (memmlp import-weights) and yours.",
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
    weigh_groups: bool,
    untrained: bool,
    seeds_needed: bool,
    official: bool,
    outputs: Path,
) -> None:
    """Show the table of a sweep.

    NAME is the path of a sweep file, a shipped sweep, the number of a table, or `all`. Use the same OVERRIDES
    as in `memmlp sweep`, so that the command finds the sweep's runs.
    """
    from memmlp.report.tables.measured_run import load_measured_run

    selection = TableSelection(branch, source, together, weigh_groups, untrained)
    gc.disable()  # garbage collection takes a second and finds nothing here
    try:
        results = gather_tables(
            name, overrides, outputs, SHOWN_MODES[mode], functools.cache(load_measured_run), selection
        )
    finally:
        gc.enable()
    if seeds_needed:
        print_needed_seeds(results, SHOWN_MODES[mode])
        return
    if official:
        print_official_values(results, outputs, SHOWN_MODES[mode])
        return
    tables = [one.table for one in results]
    if form is None and out is None:
        print_tables(tables)
        return
    text = _format_tables(tables, form or _choose_format(out), alone=name != "all")
    if out is None:
        click.echo(text, nl=False)
    else:
        write(out, text)


def print_needed_seeds(tables: Sequence[SweepTable], modes: Sequence[str]) -> None:
    """Print the number of seeds that the paper's effects need, for each sweep."""
    from memmlp.report.tables.effects import compute_needed_seeds
    from memmlp.report.tables.table_text import make_caption

    for one in tables:
        rows = [("variant", "mode", "metric", "paper", "here", "seeds", "needed")]
        for row in compute_needed_seeds(one.sweep, one.runs, modes):
            numbers = f"{row.paper:+.2f}", f"{row.measured:+.2f}", str(row.seeds)
            rows.append((*row.key, *numbers, str(row.needed or "no number is enough")))
        click.echo("\n".join([make_caption(one.table), *align_columns(rows, left=3), ""]))


def print_official_values(tables: Sequence[SweepTable], outputs: Path, modes: Sequence[str]) -> None:
    """Print published values, values of imported weights and values of trainings, for each sweep."""
    from memmlp.report.tables.build_table import (
        find_imported_runs,
        list_official_values,
        select_imported_runs,
    )
    from memmlp.report.tables.table_text import make_caption

    imported = find_imported_runs(outputs)
    for one in tables:
        head = ("variant", "mode", "metric", "published", "weights, authors' test", "weights", "trained here")
        rows = list_official_values(one.sweep, one.runs, imported, modes)
        files = [
            f"{variant.label}: weights {run.origin.imported}"
            for variant in one.sweep.variants
            for run in select_imported_runs(one.sweep, variant, imported)
        ]
        lines = [*align_columns([head, *rows], left=3), *files, ""]
        click.echo("\n".join([make_caption(one.table), *lines]))


class TableSelection(NamedTuple):
    """A selection of a sweep's results for its table. `branch`: None for each variant's default; `source`:
    show only its test clips; `together`: patterns of test clips that count as one group, in addition to the
    groups of the data; `weigh_groups`: give each group the same weight; `untrained`: measure the costs of
    networks without a run, with random weights."""

    branch: str | None = None
    source: str | None = None
    together: Sequence[str] = ()
    weigh_groups: bool = False
    untrained: bool = False


EVERYTHING = TableSelection()


class SweepTable(NamedTuple):
    """A sweep, the finished runs of its variants by seed, and its table."""

    sweep: Sweep
    runs: dict[str, RunsBySeed]
    table: Table


def gather_tables(
    name: str,
    overrides: Sequence[str],
    outputs: Path,
    modes: Sequence[str],
    read: ReadRun,
    selection: TableSelection = EVERYTHING,
) -> list[SweepTable]:
    """Make the tables of one sweep, or with `all`, of all tables of the paper. If the config of a paper's
    table is incomplete (for example without the folder of AMASS), it shows only the paper's values and the
    reason. `read` reads a run (`memmlp.report.tables.measured_run.load`). Raises InputError if no table can
    be composed with these overrides, or no table has the selected results."""
    from memmlp.common.progress import progress_bar
    from memmlp.report.tables.build_table import make_empty_table

    tables, failures = [], []
    sweeps = find_sweeps(name, overrides)
    for sweep, command in progress_bar(sweeps, "tables") if len(sweeps) > 1 else sweeps:
        sweep = sweep.with_branch(selection.branch) if selection.branch else sweep
        if selection.untrained:
            from memmlp.config.untrained_costs import check_costs

            check_costs(sweep)
        try:
            shown = load_shown_sweep(sweep, overrides, outputs.absolute())
            tables.append(make_plan_table(shown, modes, command, read, selection))
        except InputError as error:
            failures.append(error)
            table = make_empty_table(sweep, modes, f"nothing measured: {error}")
            tables.append(SweepTable(sweep, {variant.label: {} for variant in sweep.list_runnable()}, table))
    has_selection = overrides or selection.source or selection.together or tables[0].sweep.table is None
    if failures and has_selection and len(failures) == len(tables):
        raise failures[0]
    return tables


def make_plan_table(
    shown: ShownSweep,
    modes: Sequence[str],
    command: str,
    read: ReadRun,
    selection: TableSelection = EVERYTHING,
) -> SweepTable:
    """Return a planned sweep's finished runs, and the table of the selected results."""
    from memmlp.report.tables.build_table import (
        find_finished_runs,
        make_run_finder,
        make_state_finder,
        make_table,
        restrict_and_group_clips,
    )

    sweep, plan, rounds, flags = shown
    options = {
        f"--source {selection.source}": selection.source,
        f"--together {' '.join(selection.together)}": selection.together,
        "--weigh-groups": selection.weigh_groups,
    }
    for option, given in options.items():
        if given and rounds:
            raise InputError(f"{option}: cannot be combined with --until-decided")
    runs = find_finished_runs(sweep, make_run_finder(plan, read))
    if selection.untrained:
        from memmlp.config.untrained_costs import measure_untrained_variants

        runs, measured = measure_untrained_variants(sweep, runs)
        flags = (*flags, *measured)
    sweep, runs, restricted = restrict_and_group_clips(
        sweep, runs, selection.source, selection.together, selection.weigh_groups
    )
    flags = (*restricted, *flags)
    command = f"{command} --until-decided" if rounds else command
    table = make_table(sweep, runs, modes, command, make_state_finder(plan), rounds)
    return SweepTable(sweep, runs, replace(table, flags=(*table.flags, *flags)))


def find_sweeps(name: str, overrides: Sequence[str]) -> list[tuple[Sweep, str]]:
    """Find the sweeps with a name and overrides; return each sweep with its command."""
    from memmlp.common.files import find_packaged_folder
    from memmlp.config.compose_plan import find_sweep
    from memmlp.config.plugins import format_config_dir

    tables = sorted(path.stem for path in find_packaged_folder("sweeps").glob("table*.yaml"))
    return [
        (find_sweep(one, overrides), join_command(["memmlp", "sweep", one, *overrides, *format_config_dir()]))
        for one in (tables if name == "all" else [name])
    ]


def print_tables(tables: Sequence[Table]) -> None:
    """Print tables for the width of the screen."""
    from memmlp.common.text_formats import make_console
    from memmlp.report.tables.table_text import print_table

    console = make_console()
    for one in tables:
        print_table(one, console)


def align_columns(rows: Sequence[Sequence[str]], left: int) -> list[str]:
    """Return rows as lines of columns, with the first `left` columns aligned to the left."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(f"{text:{'<' if i < left else '>'}{widths[i]}}" for i, text in enumerate(row))
        for row in rows
    ]


def _format_tables(tables: Sequence[Table], form: str, alone: bool) -> str:
    from memmlp.report.tables.table_text import FORMATS

    texts = [FORMATS[form](one) for one in tables]
    if form == "json" and not alone:
        return "[\n" + ",\n".join(text.rstrip() for text in texts) + "\n]\n"
    return "\n".join(texts)


def _choose_format(out: Path | None) -> str:
    from memmlp.report.tables.table_text import FORMATS

    ending = out.suffix.removeprefix(".") if out else ""
    if ending not in FORMATS:
        raise InputError(f"--out {out}: must have the suffix {', '.join(FORMATS)}, or needs --format")
    return ending


def write(out: Path, text: str) -> None:
    """Write the file of --out and print its path. Raises InputError if the file cannot be written."""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        atomic_write(out, text)
    except OSError as error:
        raise InputError(f"--out {out}: {error.strerror or error}") from None
    click.echo(str(out))


class ShownSweep(NamedTuple):
    """The part of a sweep that a table shows: the sweep with the seeds that were run, its plan, the seed
    rounds that decided the verdicts (or None), and warnings if saved rounds do not fit the sweep."""

    sweep: Sweep
    plan: Plan
    rounds: Rounds | None
    flags: tuple[str, ...] = ()


def load_shown_sweep(sweep: Sweep, overrides: Sequence[str], outputs: Path) -> ShownSweep:
    """Load a sweep's plan, and its seed rounds if interim analyses were done. If the sweep has changed since,
    the rounds are ignored and a flag warns about them."""
    from memmlp.config.compose_plan import make_plan
    from memmlp.report.tables.seed_rounds import Rounds, check_same_runs

    path = get_rounds_path(sweep, outputs)
    kept = Rounds.read(path)
    if kept is None or not kept.analyses:
        return ShownSweep(sweep, make_plan(sweep, outputs), None)
    seeds_given = any(override.startswith("seed=") for override in overrides)
    if flag := flag_changed_rounds(kept, sweep, seeds_given):
        return ShownSweep(sweep, make_plan(sweep, outputs), None, (flag,))
    spent = kept.restrict_sweep(sweep)
    plan = make_plan(spent, outputs)
    try:
        check_same_runs(kept, sweep, plan, path)
    except InputError as error:
        return ShownSweep(spent, plan, None, (f"earlier interim analyses do not apply: {error}",))
    return ShownSweep(spent, plan, kept)


def flag_changed_rounds(kept: Rounds, sweep: Sweep, seeds_given: bool = False) -> str | None:
    """Return a warning if the sweep has changed since its interim analyses `kept`, or None. `seeds_given`:
    the command line sets the seeds."""
    from memmlp.report.tables.seed_rounds import start_rounds

    other = "seeds" if seeds_given else kept.find_difference(start_rounds(sweep, len(kept.seeds)))
    if other is None:
        return None
    return f"earlier interim analyses used other {other}, so the error rate of these verdicts can exceed 5 %"


def flag_earlier_rounds(sweep: Sweep, outputs: Path) -> tuple[str, ...]:
    """Return a warning for a table with a fixed number of seeds if interim analyses were done before."""
    from memmlp.report.tables.seed_rounds import Rounds

    kept = Rounds.read(get_rounds_path(sweep, outputs))
    if kept is None or not kept.analyses:
        return ()
    return ("after interim analyses, the error rate of these verdicts can exceed 5 %; see memmlp table",)


def get_rounds_path(sweep: Sweep, outputs: Path) -> Path:
    """Return the path of a sweep's saved seed rounds."""
    from memmlp.config.compose_plan import get_sweep_folder
    from memmlp.report.tables.seed_rounds import ROUNDS_FILE

    return get_sweep_folder(sweep, outputs) / ROUNDS_FILE
