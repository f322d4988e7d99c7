"""Makes a sweep's table from finished runs; nothing is trained.

The plan has the run id for each variant and seed. The results are in outputs/runs/<id>/, whichever command
made the run.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from memmlp.common.errors import InputError
from memmlp.common.files import atomic_write
from memmlp.common.overrides import select_last_by_key
from memmlp.common.text_formats import join_command
from memmlp.evaluation.metric_facts import AUTHORS
from memmlp.report.tables.effects import (
    RunsBySeed,
    compare_branches,
    compute_effects,
    estimate_mean_interval,
    find_control,
    find_paper_effect,
    use_existing_branches,
)
from memmlp.report.tables.flags import DescribeRun, find_flags, flag_early_tables
from memmlp.report.tables.measured_run import MeasuredRun, load_measured_run, select_runs_for_metric
from memmlp.report.tables.table import Cell, Effect, Key, Row, Table
from memmlp.report.tables.table_text import FORMATS
from memmlp.runs.lookup import is_trained, list_runs
from memmlp.sweep.definition import COSTS, MODES, Sweep, Variant
from memmlp.sweep.plan import Plan

if TYPE_CHECKING:
    from memmlp.report.tables.seed_rounds import Rounds

FindRun = Callable[[Variant, int], MeasuredRun | None]
ReadRun = Callable[[Path, tuple[str, ...]], MeasuredRun]


def make_run_finder(plan: Plan, read: ReadRun) -> FindRun:
    """Return a function that reads a planned run, or returns None if the run is not finished."""
    entries = {(entry.label, entry.seed): entry for entry in plan.entries}

    def find_run(variant: Variant, seed: int) -> MeasuredRun | None:
        entry = entries.get((variant.label, seed))
        complete = entry is not None and plan.is_complete(entry)
        return read(plan.get_run(entry).folder, entry.stages) if entry and complete else None

    return find_run


def make_state_finder(plan: Plan) -> DescribeRun:
    """Return a function that describes the state of a planned run; None for new and finished runs."""
    entries = {(entry.label, entry.seed): entry for entry in plan.entries}

    def describe(variant: Variant, seed: int) -> str | None:
        entry = entries.get((variant.label, seed))
        if entry is None:
            return None
        run = plan.get_run(entry)
        state = run.activity or run.state(plan.is_complete(entry))
        if state == "damaged":
            return f"damaged: {run.damage[0]}"
        if state == "trained":
            return "trained, an evaluation or export is missing"
        return state if state not in ("new", "done") else None

    return describe


def find_finished_runs(sweep: Sweep, find_run: FindRun) -> dict[str, RunsBySeed]:
    """Return the finished runs by variant label and seed."""
    return {
        variant.label: {
            seed: run for seed in sweep.get_seeds(variant) if (run := find_run(variant, seed)) is not None
        }
        for variant in sweep.list_runnable()
    }


def find_imported_runs(outputs: Path) -> list[MeasuredRun]:
    """Return the finished runs of imported weights in an outputs folder, the newest first."""
    found = [run for run in list_runs(outputs) if run.manifest.get("imported") and is_trained(run)]
    return [load_measured_run(run.folder) for run in found]


class OfficialValue(NamedTuple):
    """A published value and those measured here, in a mode, as texts: of the authors' weights by their
    released test (`authors`) and by this project's metrics (`imported`), and of trainings."""

    variant: str
    mode: str
    metric: str
    published: str
    authors: str
    imported: str
    trained: str


def list_official_values(
    sweep: Sweep, runs: Mapping[str, RunsBySeed], imported: Sequence[MeasuredRun], modes: Sequence[str]
) -> list[OfficialValue]:
    """Return the values of a sweep's variants: published, of imported weights, and of trainings.

    A mode without values is left out if another one has values.
    """
    rows = []
    for variant in sweep.variants:
        theirs = select_imported_runs(sweep, variant, imported)
        trained = runs.get(variant.label, {}).values()
        found = [mode for mode in modes if any(mode in run.means for run in (*theirs, *trained))]
        for mode, metric in itertools.product(found or [""], sweep.metrics):
            printed = (variant.paper or {}).get(metric)
            published = "-" if printed is None else f"{printed:.2f}"
            pairs = (theirs, AUTHORS), (theirs, variant.branch), (trained, variant.branch)
            values = [_format_mean(group, mode, branch, metric) for group, branch in pairs]
            if metric in COSTS:  # no released test measures them
                values[0] = "-"
            rows.append(OfficialValue(variant.label, mode, metric, published, *values))
    return rows


def select_imported_runs(
    sweep: Sweep, variant: Variant, imported: Sequence[MeasuredRun]
) -> list[MeasuredRun]:
    """Return the newest run of imported weights with the variant's network, refiner and data, if any."""
    chosen = select_last_by_key((*sweep.base, *sweep.command_line, *(variant.overrides or ())))
    keys = ("model", "data", "refiner")
    model, data, refiner = (chosen[key].value if key in chosen else None for key in keys)
    return [
        one
        for one in imported
        if one.run
        and (one.run.manifest["imported"]["model"] == model)
        and data in (None, one.run.config["data"]["name"])
        and (None if refiner == "null" else refiner) == (one.run.config["refiner"] or {}).get("name")
    ][:1]


def _format_mean(runs: Collection[MeasuredRun], mode: str, branch: str, metric: str) -> str:
    values = [value for run in runs if (value := run.get_value(mode, branch, metric)) is not None]
    if not values:
        return "-" if runs and branch == AUTHORS else "not measured"
    return f"{math.fsum(values) / len(values):.2f}"


def make_table(
    sweep: Sweep,
    runs: Mapping[str, RunsBySeed],
    modes: Sequence[str] = MODES,
    command: str | None = None,
    describe_run: DescribeRun = lambda variant, seed: None,
    rounds: Rounds | None = None,
) -> Table:
    """Make the table of a sweep.

    Args:
        sweep: the sweep; with seed rounds, `rounds.restrict_sweep(sweep)`.
        runs: the finished runs of every runnable variant, by seed (`find_finished_runs`).
        modes: the evaluation modes to show ("stream", "window"). Modes without results are left out if
            another mode has results.
        command: the command that makes missing runs; by default, `memmlp sweep` and the sweep's name.
        describe_run: describes the state of an unfinished run, or returns None.
        rounds: the seed rounds that decided the verdicts; None for a fixed number of seeds.
    """
    has_errors = bool(set(sweep.metrics) - set(COSTS))
    evaluated = {mode for seeds in runs.values() for run in seeds.values() for mode in run.means}
    existing = tuple(mode for mode in modes if mode in evaluated) or tuple(modes)
    shown_modes = existing if has_errors else tuple(modes)[:1]
    shown = use_existing_branches(sweep, runs)
    # The correction includes both modes, even if only one is shown.
    effects = compute_effects(shown, runs, MODES if has_errors else shown_modes)
    comparisons = sum(effect.p is not None for effect in effects.values())
    if rounds:
        effects, comparisons = rounds.apply_verdicts(effects), len(rounds.list_comparison_keys(sweep))
    branches = compare_branches(shown, runs, MODES) if has_errors else {}
    if rounds:  # their numbers of seeds were chosen by verdicts on other branches
        branches = {branch: _drop_verdicts(found) for branch, found in branches.items()}
    flags = find_flags(
        shown, sweep, runs, command or join_command(["memmlp", "sweep", sweep.name]), describe_run
    )
    rows = (_make_row(shown, one, runs.get(one.label), shown_modes, effects) for one in shown.variants)
    return Table(
        name=sweep.name,
        title=sweep.title,
        number=sweep.table,
        modes=shown_modes,
        metrics=sweep.metrics,
        control=sweep.control,
        branch_source=sweep.branch_source,
        smallest=dict(sweep.smallest),
        comparisons=comparisons,
        rows=tuple(_add_branches(row, runs, branches, shown_modes) for row in rows),
        notes=(*sweep.notes, *(f"{one.label}: {one.note}" for one in sweep.variants if one.note)),
        flags=(*flags, *(() if rounds else flag_early_tables(shown, runs))),
        analyses=tuple((one.seeds, one.level) for one in rounds.analyses) if rounds else (),
    )


def _make_row(
    sweep: Sweep,
    variant: Variant,
    runs: RunsBySeed | None,
    modes: Sequence[str],
    effects: Mapping[Key, Effect],
) -> Row:

    def make_cell(mode: str, metric: str) -> Cell:
        counted = select_runs_for_metric(metric, runs or {})
        numbers = {seed: run.get_value(mode, variant.branch, metric) for seed, run in counted.items()}
        values = {seed: value for seed, value in numbers.items() if value is not None}
        effect = effects.get(Key(variant.label, mode, metric))
        cell = Cell(
            values, (variant.paper or {}).get(metric), effect, find_paper_effect(sweep, variant, metric)
        )
        if not values or metric in COSTS:
            return cell
        measured = [counted[seed] for seed in values]
        counted_clips, clips = min(run.count_clips(mode, variant.branch, metric) for run in measured)
        low, high = estimate_mean_interval(measured, mode, variant.branch, metric)
        return replace(cell, counted=counted_clips, clips=clips, low=low, high=high)

    control = find_control(sweep, variant)
    pairing = ""
    if control and variant.cell and control.cell == variant.cell:
        pairing = f"'{variant.series}' from '{control.series}' in the same cell"
    return Row(
        label=variant.label,
        branch=variant.branch,
        against=control.label if control else None,
        note=variant.note,
        found=tuple(runs or ()),
        wanted=sweep.get_seeds(variant) if runs is not None else (),
        cells={mode: {metric: make_cell(mode, metric) for metric in sweep.metrics} for mode in modes},
        pairing=pairing,
        confounded=variant.confounded,
        series=variant.series or variant.label,
        costs=_average_costs(runs or {}),
        groups=max(
            (len({run.get_group(clip) for clip in run.clips}) for run in (runs or {}).values()), default=0
        ),
    )


def _average_costs(runs: RunsBySeed) -> dict[str, float]:
    """Return the means of costs and training costs that all runs have."""
    found = [{**run.training, **run.costs} for run in runs.values()]
    names = [name for name in (*COSTS, "tflop", "seconds") if found and all(name in one for one in found)]
    return {name: math.fsum(one[name] for one in found) / len(found) for name in names}


def _add_branches(
    row: Row,
    runs: Mapping[str, RunsBySeed],
    branches: Mapping[str, Mapping[Key, Effect]],
    modes: Sequence[str],
) -> Row:
    """Return a row with its effects in other branches, and the branches that it or its control lacks."""
    found = {
        branch: {
            mode: {key.metric: one for key, one in effects.items() if key[:2] == (row.label, mode)}
            for mode in modes
        }
        for branch, effects in branches.items()
    }
    both = [run for label in (row.label, row.against or "") for run in runs.get(label, {}).values()]
    return replace(
        row,
        branches={branch: by_mode for branch, by_mode in found.items() if any(by_mode.values())},
        unrecorded=tuple(
            one for one in branches if row.against and not all(run.has_branch(one) for run in both)
        ),
    )


def _drop_verdicts(effects: Mapping[Key, Effect]) -> dict[Key, Effect]:
    return {key: replace(one, verdict=None, p=None, holm=None, equal=None) for key, one in effects.items()}


def make_empty_table(sweep: Sweep, modes: Sequence[str], reason: str) -> Table:
    """Make a table with only the paper's values, and flag the reason why runs can't be identified."""
    runs: dict[str, RunsBySeed] = {variant.label: {} for variant in sweep.list_runnable()}
    return replace(make_table(sweep, runs, modes), flags=(reason,))


def restrict_to_source(
    sweep: Sweep, runs: Mapping[str, RunsBySeed], source: str
) -> tuple[Sweep, dict[str, RunsBySeed], tuple[str, ...]]:
    """Restrict a sweep and its finished runs to one source's test clips.

    If the control has no such clips, the first variant with such clips becomes the control.

    Returns:
        The sweep without the variants that have no test clip from the source; the runs of the remaining
        variants, by seed, restricted to the source's clips; and a flag that lists the removed variants.

    Raises:
        InputError: if no run has a test clip from the source.
    """
    parts = {
        label: {seed: run.split_by_source() for seed, run in seeds.items()} for label, seeds in runs.items()
    }
    restricted: dict[str, RunsBySeed] = {
        label: {seed: found[source] for seed, found in seeds.items() if source in found}
        for label, seeds in parts.items()
    }
    if not any(restricted.values()):
        names = sorted(
            {name for seeds in parts.values() for by_source in seeds.values() for name in by_source}
        )
        expected = f"must be {' or '.join(names)}" if names else "the data has a single source"
        raise InputError(f"--source {source}: no finished run has test clips from this source; {expected}")
    removed = {label for label, seeds in runs.items() if seeds and not restricted[label]}
    variants = [
        replace(one, against=None) if one.against in removed else one
        for one in sweep.variants
        if one.label not in removed
    ]
    remaining = {label: seeds for label, seeds in restricted.items() if label not in removed}
    control = sweep.control
    if control in removed:
        control = next(label for label, seeds in remaining.items() if seeds)
    quoted = ", ".join(f"'{one.label}'" for one in sweep.variants if one.label in removed)
    flags = (f"no test clip of {source}, so left out: {quoted}",) if removed else ()
    title = f"{sweep.title} (test clips of {source} alone)"
    return replace(sweep, variants=tuple(variants), control=control, title=title), remaining, flags


def restrict_and_group_clips(
    sweep: Sweep,
    runs: Mapping[str, RunsBySeed],
    source: str | None,
    patterns: Sequence[str],
    weigh_groups: bool = False,
) -> tuple[Sweep, dict[str, RunsBySeed], tuple[str, ...]]:
    """Restrict a sweep and its runs to a source, if given, and group clips by patterns, if given. With
    `weigh_groups`, each group of clips has the same weight.

    Raises:
        InputError: if no run has test clips of the source; if a pattern is not valid; or with `weigh_groups`,
            if runs have different test clips, so that a group's means would be of different clips.
    """
    flags: tuple[str, ...] = ()
    if source:
        sweep, runs, flags = restrict_to_source(sweep, runs, source)
    grouped, group_flags = group_clips(runs, patterns)
    if weigh_groups:
        if len({frozenset(run.clips) for seeds in grouped.values() for run in seeds.values()}) > 1:
            raise InputError("--weigh-groups: all runs must have the same test clips; --source may help")
        grouped = _change_runs(grouped, MeasuredRun.average_groups)
        group_flags = (*group_flags, "each group of test clips has the same weight")
    return sweep, grouped, (*flags, *group_flags)


def _change_runs(
    runs: Mapping[str, RunsBySeed], change: Callable[[MeasuredRun], MeasuredRun]
) -> dict[str, RunsBySeed]:
    return {label: {seed: change(run) for seed, run in seeds.items()} for label, seeds in runs.items()}


def group_clips(
    runs: Mapping[str, RunsBySeed], patterns: Sequence[str]
) -> tuple[dict[str, RunsBySeed], tuple[str, ...]]:
    """Merge groups of test clips with equal matches of a pattern.

    Statistics count groups, so this shows how much a table depends on the grouping.

    Args:
        runs: the finished runs of a sweep's variants, by seed.
        patterns: regular expressions, as in `data.split.groups`, with parentheses around the text that the
            clips of a group share.

    Returns:
        The variants' runs by seed, and a flag that describes the merged groups.

    Raises:
        InputError: if a pattern is not a regular expression, has no parentheses, or merges no groups.
    """

    def regroup(*patterns: str) -> dict[str, RunsBySeed]:
        return _change_runs(runs, lambda run: run.group_clips(patterns))

    def count_groups(runs: Mapping[str, RunsBySeed]) -> int:
        every = (run for seeds in runs.values() for run in seeds.values())
        return len({run.get_group(clip) for run in every for clip in run.clips})

    before = count_groups(runs)
    for pattern in patterns:
        try:
            captured = re.compile(pattern).groups
        except re.error as error:
            raise InputError(f"--together {pattern}: not a regular expression ({error})") from None
        if captured == 0:
            raise InputError(f"--together {pattern}: must have (parentheses) around the text of a group")
        if count_groups(regroup(pattern)) == before:
            raise InputError(f"--together {pattern}: must match clips in different groups; nothing to merge")
    if not patterns:
        return dict(runs), ()
    regrouped = regroup(*patterns)
    quoted = ", ".join(f"'{pattern}'" for pattern in patterns)
    counts = f"{before} groups of test clips into {count_groups(regrouped)}"
    return regrouped, (f"--together merged {counts}: clips with equal matches of {quoted} form a group",)


def write_table(table: Table, folder: Path) -> None:
    """Write a sweep's table into its folder, as table.md."""
    folder.mkdir(parents=True, exist_ok=True)
    atomic_write(folder / "table.md", FORMATS["md"](table))
