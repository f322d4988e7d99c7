"""`memmlp table`: show measured values beside the paper's values."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import click

from memmlp.cli.options import (
    HomePath,
    add_clip_options,
    add_run_options,
    config_dir_option,
    overrides_argument,
    untrained_option,
)
from memmlp.common.errors import InputError
from memmlp.common.files import atomic_write, find_packaged_folder
from memmlp.common.progress import progress_bar
from memmlp.common.text_formats import join_command, make_console
from memmlp.config.compose_plan import find_sweep, get_sweep_folder, make_plan
from memmlp.config.plugins import format_config_dir
from memmlp.sweep.definition import BRANCHES, Sweep
from memmlp.sweep.plan import Plan

if TYPE_CHECKING:
    from memmlp.report.tables.effects import RunsBySeed
    from memmlp.report.tables.seed_rounds import Rounds
    from memmlp.report.tables.table import Table

SHOWN_MODES = {"stream": ("stream",), "window": ("window",), "both": ("stream", "window")}


@click.command("table")
@click.argument("name")
@overrides_argument
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
@add_clip_options
@untrained_option
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
@add_run_options
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
    selection = TableSelection(branch, source, together, weigh_groups, untrained)
    modes = SHOWN_MODES[mode]
    results = gather_tables(name, overrides, outputs, modes, selection)
    tables = [one.table for one in results]
    if seeds_needed:
        return print_needed_seeds(results, modes)
    if official:
        return print_official_values(results, outputs, modes)
    if form is None and out is None:
        return print_tables(tables)
    text = _format_tables(tables, form, out, as_list=name == "all")
    if out:
        write(out, text)
    else:
        click.echo(text, nl=False)


def print_needed_seeds(tables: Sequence[SweepTable], modes: Sequence[str]) -> None:
    from memmlp.report.tables.effects import compute_needed_seeds
    from memmlp.report.tables.table_text import make_caption

    for one in tables:
        rows = [("variant", "mode", "metric", "paper", "here", "seeds", "needed")]
        for row in compute_needed_seeds(one.sweep, one.runs, modes):
            numbers = f"{row.paper:+.2f}", f"{row.measured:+.2f}", str(row.seeds)
            rows.append((*row.key, *numbers, str(row.needed or "no number is enough")))
        click.echo("\n".join([make_caption(one.table), *align_columns(rows, left=3), ""]))


def print_official_values(tables: Sequence[SweepTable], outputs: Path, modes: Sequence[str]) -> None:
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
    """A selection of a sweep's results for its table. `branch`: None for each variant's default; `together`:
    patterns of test clips that count as one group; `untrained`: measure networks without a run, with random
    weights."""

    branch: str | None = None
    source: str | None = None
    together: Sequence[str] = ()
    weigh_groups: bool = False
    untrained: bool = False


EVERYTHING = TableSelection()


class SweepTable(NamedTuple):
    sweep: Sweep
    runs: dict[str, RunsBySeed]
    table: Table


def gather_tables(
    name: str, overrides: Sequence[str], outputs: Path, modes: Sequence[str], selection: TableSelection
) -> list[SweepTable]:
    """Make the tables of one sweep, or with `all`, of all tables of the paper. If a table's config is
    incomplete (for example without the folder of AMASS), it shows only the paper's values and the reason."""
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
            tables.append(make_plan_table(shown, modes, command, selection))
        except InputError as error:
            failures.append(error)
            table = make_empty_table(sweep, modes, f"nothing measured: {error}")
            tables.append(SweepTable(sweep, {variant.label: {} for variant in sweep.list_runnable()}, table))
    chosen = overrides or selection.source or selection.together
    if failures and len(failures) == len(tables) and (chosen or tables[0].sweep.table is None):
        raise failures[0]
    return tables


def make_plan_table(
    shown: ShownSweep, modes: Sequence[str], command: str, selection: TableSelection = EVERYTHING
) -> SweepTable:
    from memmlp.report.tables.build_table import make_state_finder, make_table, restrict_and_group_clips

    sweep, plan, rounds, _ = shown
    if rounds and (selection.source or selection.together or selection.weigh_groups):
        options = "--source, --together, --weigh-groups"
        raise InputError(f"{options}: cannot be combined with --until-decided")
    runs, flags = find_shown_runs(shown, selection.untrained)
    sweep, runs, restricted = restrict_and_group_clips(
        sweep, runs, selection.source, selection.together, selection.weigh_groups
    )
    command = f"{command} --until-decided" if rounds else command
    table = make_table(sweep, runs, modes, command, make_state_finder(plan), rounds)
    return SweepTable(sweep, runs, replace(table, flags=(*table.flags, *restricted, *flags)))


def find_shown_runs(shown: ShownSweep, untrained: bool) -> tuple[dict[str, RunsBySeed], tuple[str, ...]]:
    """Return a sweep's finished runs by variant and seed, and its flags. With `untrained`, networks without a
    run are measured with random weights."""
    from memmlp.report.tables.build_table import find_finished_runs, make_run_finder
    from memmlp.report.tables.measured_run import load_measured_run

    runs = find_finished_runs(shown.sweep, make_run_finder(shown.plan, functools.cache(load_measured_run)))
    if not untrained:
        return runs, shown.flags
    from memmlp.config.untrained_costs import measure_untrained_variants

    runs, measured = measure_untrained_variants(shown.sweep, runs)
    return runs, (*shown.flags, *measured)


def find_sweeps(name: str, overrides: Sequence[str]) -> list[tuple[Sweep, str]]:
    """Return the sweeps with a name and overrides, each with its command."""
    tables = sorted(path.stem for path in find_packaged_folder("sweeps").glob("table*.yaml"))
    return [
        (find_sweep(one, overrides), join_command(["memmlp", "sweep", one, *overrides, *format_config_dir()]))
        for one in (tables if name == "all" else [name])
    ]


def print_tables(tables: Sequence[Table]) -> None:
    from memmlp.report.tables.table_text import print_table

    for one in tables:
        print_table(one, make_console())


def align_columns(rows: Sequence[Sequence[str]], left: int) -> list[str]:
    """Return rows as lines of columns, with the first `left` columns aligned to the left."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(f"{text:{'<' if i < left else '>'}{widths[i]}}" for i, text in enumerate(row))
        for row in rows
    ]


def _format_tables(tables: Sequence[Table], form: str | None, out: Path | None, as_list: bool) -> str:
    from memmlp.report.tables.table_text import FORMATS

    form = form or (out.suffix.removeprefix(".") if out else "")
    if form not in FORMATS:
        raise InputError(f"--out {out}: must have the suffix {', '.join(FORMATS)}, or needs --format")
    texts = [FORMATS[form](one) for one in tables]
    if form == "json" and as_list:
        return "[\n" + ",\n".join(text.rstrip() for text in texts) + "\n]\n"
    return "\n".join(texts)


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
    """Load a sweep's plan and seed rounds. If the sweep has changed since, a flag replaces the rounds."""
    from memmlp.report.tables.seed_rounds import check_same_runs

    if (kept := read_rounds(sweep, outputs)) is None:
        return ShownSweep(sweep, make_plan(sweep, outputs), None)
    seeds_given = any(override.startswith("seed=") for override in overrides)
    if flag := flag_changed_rounds(kept, sweep, seeds_given):
        return ShownSweep(sweep, make_plan(sweep, outputs), None, (flag,))
    spent = kept.restrict_sweep(sweep)
    plan = make_plan(spent, outputs)
    try:
        check_same_runs(kept, sweep, plan, get_rounds_path(sweep, outputs))
    except InputError as error:
        return ShownSweep(spent, plan, None, (f"earlier interim analyses do not apply: {error}",))
    return ShownSweep(spent, plan, kept)


def flag_changed_rounds(kept: Rounds, sweep: Sweep, seeds_given: bool = False) -> str | None:
    """Return a warning if the sweep has changed since its interim analyses `kept`, or None."""
    from memmlp.report.tables.seed_rounds import start_rounds

    other = "seeds" if seeds_given else kept.find_difference(start_rounds(sweep, len(kept.seeds)))
    if other is None:
        return None
    return f"earlier interim analyses used other {other}, so the error rate of these verdicts can exceed 5 %"


def flag_earlier_rounds(sweep: Sweep, outputs: Path) -> tuple[str, ...]:
    if read_rounds(sweep, outputs) is None:
        return ()
    return ("after interim analyses, the error rate of these verdicts can exceed 5 %; see memmlp table",)


def read_rounds(sweep: Sweep, outputs: Path) -> Rounds | None:
    """Read a sweep's saved seed rounds; None if no interim analysis was done yet."""
    from memmlp.report.tables.seed_rounds import Rounds

    kept = Rounds.read(get_rounds_path(sweep, outputs))
    return kept if kept and kept.analyses else None


def get_rounds_path(sweep: Sweep, outputs: Path) -> Path:
    from memmlp.report.tables.seed_rounds import ROUNDS_FILE

    return get_sweep_folder(sweep, outputs) / ROUNDS_FILE
