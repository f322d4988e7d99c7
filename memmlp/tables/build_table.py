"""Makes the numbers of a table from a sweep and its finished runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from memmlp.common.errors import InputError
from memmlp.sweep.definition import COSTS, MODES, Sweep, Variant
from memmlp.tables.effects import RunsBySeed, control_variant, effects, paper_effect, with_existing_branches
from memmlp.tables.flags_of_runs import DescribeRun, early_looks, flags, silent
from memmlp.tables.measured_run import Measured
from memmlp.tables.table import Cell, Effect, Key, Row, Table
from memmlp.tables.undisturbed_times import measured_for

if TYPE_CHECKING:
    from memmlp.tables.seed_rounds import Rounds

Find = Callable[[Variant, int], Measured | None]


def finished_runs(sweep: Sweep, find: Find) -> dict[str, RunsBySeed]:
    """Return the finished runs of each runnable variant, by seed."""
    return {
        variant.label: {
            seed: run for seed in sweep.seeds_of(variant) if (run := find(variant, seed)) is not None
        }
        for variant in sweep.runnable()
    }


def make_table(
    sweep: Sweep,
    runs: Mapping[str, RunsBySeed],
    modes: Sequence[str] = MODES,
    command: str | None = None,
    state: DescribeRun = silent,
    older: DescribeRun = silent,
    rounds: Rounds | None = None,
) -> Table:
    """Make the table of a sweep.

    Args:
        sweep: the sweep; if seeds were spent in rounds, `rounds.spent(sweep)`.
        runs: the finished runs of every runnable variant, by seed (`finished_runs`).
        modes: the modes of evaluation to show ("stream", "window"); a mode that no run has is left out, if
            runs have another one.
        command: the command that makes missing runs; `memmlp sweep` with the sweep's name by default.
        state: describes in a word the state of a variant's and seed's unfinished run, or returns None.
        older: names the run with an earlier recipe that exists in place of a missing one, or returns None.
        rounds: the rounds that decided the verdicts; None for verdicts from a fixed number of seeds.
    """
    shown = _shown(modes, runs) if set(sweep.metrics) - set(COSTS) else tuple(modes)[:1]
    seen = with_existing_branches(sweep, runs)
    # The correction is over both modes, whichever of them are shown.
    every = MODES if set(sweep.metrics) - set(COSTS) else shown
    found = effects(seen, runs, every)
    compared = sum(effect.p is not None for effect in found.values())
    if rounds:
        found, compared = rounds.judged(found), len(rounds.family(sweep))
    flagged = flags(seen, sweep, runs, command or f"memmlp sweep {sweep.name}", state, older)
    return Table(
        name=sweep.name,
        title=sweep.title,
        number=sweep.table,
        modes=shown,
        metrics=sweep.metrics,
        control=sweep.control,
        branch_source=sweep.branch_source,
        smallest=dict(sweep.smallest),
        comparisons=compared,
        rows=tuple(_row(seen, variant, runs.get(variant.label), shown, found) for variant in seen.variants),
        notes=(
            *sweep.notes,
            *(f"{variant.label}: {variant.note}" for variant in sweep.variants if variant.note),
        ),
        flags=(*flagged, *(() if rounds else early_looks(seen, runs))),
        looks=tuple((look.seeds, look.level) for look in rounds.taken) if rounds else (),
    )


def _shown(modes: Sequence[str], runs: Mapping[str, RunsBySeed]) -> tuple[str, ...]:
    """Return those of the modes in which runs were evaluated; all modes if there are no evaluations."""
    measured = {mode for found in runs.values() for run in found.values() for mode in run.means}
    return tuple(mode for mode in modes if mode in measured) or tuple(modes)


class OnSource(NamedTuple):
    """A sweep and its finished runs on the test clips of one source of motion.

    Attributes:
        sweep: the sweep without the variants whose runs have no test clip from the source.
        runs: the runs of the remaining variants, by seed, evaluated on these clips alone.
        flags: a line that names the variants left out.
    """

    sweep: Sweep
    runs: dict[str, RunsBySeed]
    flags: tuple[str, ...]


def on_source(sweep: Sweep, runs: Mapping[str, RunsBySeed], source: str) -> OnSource:
    """Restrict a sweep and its finished runs to one source's test clips.

    If the control has no such clips, the first variant that has some becomes the control.

    Raises:
        InputError: if no run has a test clip from the source.
    """
    own: dict[str, RunsBySeed] = {
        label: {seed: parts[source] for seed, run in seeds.items() if source in (parts := run.by_source())}
        for label, seeds in runs.items()
    }
    if not any(own.values()):
        known = sorted(
            {name for seeds in runs.values() for run in seeds.values() for name in run.by_source()}
        )
        allowed = f"allowed is {', '.join(known)}" if known else "allowed with several sources"
        raise InputError(f"--source {source}: no finished run has a test clip of it; {allowed}")
    without = {label for label, seeds in runs.items() if seeds and not own[label]}
    variants = [variant for variant in sweep.variants if variant.label not in without]
    variants = [
        replace(variant, against=None) if variant.against in without else variant for variant in variants
    ]
    left = {label: seeds for label, seeds in own.items() if label not in without}
    control = (
        next(label for label, seeds in left.items() if seeds) if sweep.control in without else sweep.control
    )
    quoted = ", ".join(f"'{variant.label}'" for variant in sweep.variants if variant.label in without)
    flags = (f"no test clip of {source}, so left out: {quoted}",) if without else ()
    return OnSource(replace(sweep, variants=tuple(variants), control=control), left, flags)


def titled(table: Table, source: str) -> Table:
    """Return a table of one source's test clips with a title that names the source."""
    return replace(table, title=f"{table.title} (test clips of {source} alone)")


class Together(NamedTuple):
    """Finished runs whose test clips are in coarser groups than their data's.

    Attributes:
        runs: the runs of the variants, by seed.
        flags: a line that says which clips are together, and how many groups there are.
    """

    runs: dict[str, RunsBySeed]
    flags: tuple[str, ...]


def together(runs: Mapping[str, RunsBySeed], patterns: Sequence[str]) -> Together:
    """Put test clips into one group, too, whose names match a pattern alike.

    Statistics count groups, so this shows what of a table hangs on their choice.

    Args:
        runs: the finished runs of a sweep's variants, by seed.
        patterns: regular expressions, as those of `data.split.groups`.

    Raises:
        InputError: for a pattern that is no regular expression, or puts nothing together.
    """
    for pattern in patterns:
        try:
            tied = _regrouped(runs, [pattern])
        except InputError as error:
            raise InputError(f"--together {str(error).partition(': ')[2]}") from None
        if _group_count(tied) == _group_count(runs):
            raise InputError(f"--together {pattern}: puts no test clips together; allowed is one that does")
    if not patterns:
        return Together(dict(runs), ())
    own = _regrouped(runs, patterns)
    words = f"{_group_count(own)} groups of test clips in place of {_group_count(runs)}"
    quoted = ", ".join(f"'{pattern}'" for pattern in patterns)
    return Together(own, (f"{words}: those whose names match {quoted} alike are together (--together)",))


def _regrouped(runs: Mapping[str, RunsBySeed], patterns: Sequence[str]) -> dict[str, RunsBySeed]:
    return {
        label: {seed: run.together(patterns) for seed, run in seeds.items()} for label, seeds in runs.items()
    }


def _group_count(runs: Mapping[str, RunsBySeed]) -> int:
    """Return how many groups the test clips of all runs are in."""
    every = (run for seeds in runs.values() for run in seeds.values())
    return len({run.group(clip) for run in every for clip in run.clips})


def without_runs(sweep: Sweep, modes: Sequence[str], reason: str) -> Table:
    """Make the table of a sweep whose runs can't be identified: the paper's values, and the reason."""
    return replace(
        make_table(sweep, {variant.label: {} for variant in sweep.runnable()}, modes), flags=(reason,)
    )


def _row(
    sweep: Sweep, variant: Variant, runs: RunsBySeed | None, modes: Sequence[str], found: Mapping[Key, Effect]
) -> Row:
    """Return a variant's row; `runs` is None for a row with only the paper's values."""

    def cell(mode: str, metric: str) -> Cell:
        counted = measured_for(metric, runs or {})
        numbers = {seed: run.value(mode, variant.branch, metric) for seed, run in counted.items()}
        values = {seed: value for seed, value in numbers.items() if value is not None}
        effect = found.get(Key(variant.label, mode, metric))
        return Cell(values, (variant.paper or {}).get(metric), effect, paper_effect(sweep, variant, metric))

    cells = {mode: {metric: cell(mode, metric) for metric in sweep.metrics} for mode in modes}
    wanted = sweep.seeds_of(variant) if runs is not None else ()
    against = control_variant(sweep, variant)
    other = against.label if against else None
    in_cell = against is not None and variant.cell and against.cell == variant.cell
    pairing = f"'{variant.series}' from '{against.series}' in the same cell" if against and in_cell else ""
    return Row(variant.label, variant.branch, other, variant.note, tuple(runs or ()), wanted, cells, pairing)
