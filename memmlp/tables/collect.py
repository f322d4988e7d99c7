"""From a sweep and its finished runs to a table's numbers."""

from __future__ import annotations

import functools
import itertools
import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from memmlp.runs import Run
from memmlp.statistics import holm, paired_effects
from memmlp.sweep.spec import COSTS, Arm, Sweep
from memmlp.tables.measured import Measured, load

MODES = ("stream", "window")
LEVEL = 0.05
Find = Callable[[Arm, int], Run | None]
Runs = Mapping[int, Measured]  # by seed


@dataclass(frozen=True)
class Effect:
    """An arm's difference from the reference over the seeds and clips that both have.

    Attributes:
        mean, low, high: the difference and its 95 % interval. p, holm: p-value, alone and corrected (see
            `memmlp.statistics`); None where there is none, as of costs.
        seeds, clips: how many were paired.
    """

    mean: float
    low: float | None = None
    high: float | None = None
    p: float | None = None
    holm: float | None = None
    seeds: int = 0
    clips: int = 0

    @property
    def significant(self) -> bool:
        """Whether it is significant at 5 % after the correction."""
        return self.holm is not None and self.holm < LEVEL


@dataclass(frozen=True)
class Cell:
    """A metric of an arm: the values by seed, the paper's value, and both differences from the reference."""

    values: Mapping[int, float]
    paper: float | None = None
    effect: Effect | None = None
    paper_effect: float | None = None

    @property
    def mean(self) -> float | None:
        """Mean over seeds."""
        return math.fsum(self.values.values()) / len(self.values) if self.values else None

    @property
    def sd(self) -> float | None:
        """Standard deviation over seeds (n - 1); None under two."""
        if self.mean is None or len(self.values) < 2:
            return None
        squares = math.fsum((value - self.mean) ** 2 for value in self.values.values())
        return math.sqrt(squares / (len(self.values) - 1))

    @property
    def agrees(self) -> bool | None:
        """Whether the measured difference has the sign of the paper's; None where either is missing or 0."""
        if self.effect is None or not self.paper_effect or not self.effect.mean:
            return None
        return (self.effect.mean > 0) == (self.paper_effect > 0)


@dataclass(frozen=True)
class Row:
    """An arm.

    Attributes:
        label, branch, note: of the sweep's arm.
        found, wanted: seeds; none is wanted of a row that is the paper's alone.
        cells: by mode and metric.
    """

    label: str
    branch: str
    note: str | None
    found: tuple[int, ...]
    wanted: tuple[int, ...]
    cells: Mapping[str, Mapping[str, Cell]]

    @property
    def paper_only(self) -> bool:
        """Whether nothing is measured for this row."""
        return not self.wanted


@dataclass(frozen=True)
class Table:
    """A sweep's arms side by side.

    Attributes:
        name, title, number: of the sweep; the number is that in the paper.
        modes: of evaluation; one where only costs are shown. metrics: the columns.
        reference: label of the arm that the others are compared with.
        comparisons: how many p-values the correction is over.
        notes: about the paper's values. flags: what a reader has to know of these runs.
    """

    name: str
    title: str
    number: int | None
    modes: tuple[str, ...]
    metrics: tuple[str, ...]
    reference: str
    comparisons: int
    rows: tuple[Row, ...]
    notes: tuple[str, ...]
    flags: tuple[str, ...]

    @property
    def signs(self) -> tuple[int, int, int, int]:
        """How many effects have the paper's sign, of how many; and of the significant ones."""
        cells = [cell for row in self.rows for cells in row.cells.values() for cell in cells.values()]
        known = [cell for cell in cells if cell.agrees is not None]
        sure = [cell for cell in known if cell.effect and cell.effect.significant]
        return sum(bool(c.agrees) for c in known), len(known), sum(bool(c.agrees) for c in sure), len(sure)


class Key(NamedTuple):
    """The place of a cell."""

    label: str
    mode: str
    metric: str


def collect(
    sweep: Sweep,
    find: Find,
    modes: Sequence[str] = MODES,
    command: str | None = None,
    read: Callable[[Path], Measured] | None = None,
) -> Table:
    """The table of a sweep.

    Args:
        find: gives the run of an arm and a seed, finished or not; None where it is not known.
        modes: of evaluation ("stream", "window"). command: what fills the missing arms.
        read: reads a finished run's folder; a cache of `load` shared by tables saves time.
    """
    read = read or functools.cache(load)
    shown = tuple(modes) if set(sweep.metrics) - set(COSTS) else tuple(modes)[:1]
    runs = finished(sweep, find, read)
    effects = _effects(sweep, runs, shown)
    compared = sum(effect.p is not None for effect in effects.values())
    return Table(
        sweep.name,
        sweep.title,
        sweep.table,
        shown,
        sweep.metrics,
        sweep.reference,
        compared,
        tuple(_row(sweep, arm, runs.get(arm.label), shown, effects) for arm in sweep.arms),
        (*sweep.notes, *(f"{arm.label}: {arm.note}" for arm in sweep.arms if arm.note)),
        tuple(_flags(sweep, runs, find, command or f"memmlp sweep {sweep.name}", compared)),
    )


def nothing(arm: Arm, seed: int) -> Run | None:
    """Finds no run."""
    return None


def without_runs(sweep: Sweep, modes: Sequence[str], reason: str) -> Table:
    """The table of a sweep whose runs cannot be known: the paper's values, and why there is no more."""
    table = collect(sweep, nothing, modes)
    return replace(table, flags=(reason,))


def finished(sweep: Sweep, find: Find, read: Callable[[Path], Measured]) -> dict[str, Runs]:
    """The finished runs of each arm, by seed."""
    return {
        arm.label: {
            seed: read(run.folder)
            for seed in sweep.seeds
            if (run := find(arm, seed)) is not None and run.done
        }
        for arm in sweep.runnable()
    }


def _row(
    sweep: Sweep, arm: Arm, runs: Runs | None, modes: Sequence[str], effects: Mapping[Key, Effect]
) -> Row:
    def cell(mode: str, metric: str) -> Cell:
        found = {seed: run.value(mode, arm.branch, metric) for seed, run in (runs or {}).items()}
        values = {seed: value for seed, value in found.items() if value is not None}
        effect = effects.get(Key(arm.label, mode, metric))
        return Cell(values, (arm.paper or {}).get(metric), effect, _paper_effect(sweep, arm, metric))

    cells = {mode: {metric: cell(mode, metric) for metric in sweep.metrics} for mode in modes}
    wanted = sweep.seeds if runs is not None else ()
    return Row(arm.label, arm.branch, arm.note, tuple(runs or ()), wanted, cells)


def _paper_effect(sweep: Sweep, arm: Arm, metric: str) -> float | None:
    """The paper's difference from the reference, as printed."""
    ours, theirs = (arm.paper or {}).get(metric), (_reference(sweep).paper or {}).get(metric)
    if arm.label == sweep.reference or arm.overrides is None or ours is None or theirs is None:
        return None
    return round(ours - theirs, 6)


def _reference(sweep: Sweep) -> Arm:
    return next(arm for arm in sweep.arms if arm.label == sweep.reference)


def _effects(sweep: Sweep, runs: Mapping[str, Runs], modes: Sequence[str]) -> dict[Key, Effect]:
    """The differences of all arms from the reference, the p-values corrected over all of them."""
    reference = _reference(sweep)
    theirs, costs, differences = runs[reference.label], dict[Key, Effect](), dict[Key, np.ndarray]()
    for arm in sweep.runnable():
        ours = runs[arm.label]
        shared = _shared(ours, theirs)
        for mode, metric in itertools.product(modes, sweep.metrics):
            key = Key(arm.label, mode, metric)
            if arm is reference:
                continue
            if metric in COSTS:
                costs |= _cost_effect(key, ours, theirs)
            else:
                branches = (arm.branch, reference.branch)
                differences[key] = _differences(ours, theirs, shared, branches, mode, metric)
    return costs | _tested({key: matrix for key, matrix in differences.items() if matrix.size})


def _differences(
    ours: Runs,
    theirs: Runs,
    shared: tuple[list[int], list[str]],
    branches: tuple[str, str],
    mode: str,
    metric: str,
) -> np.ndarray:
    """Ours less theirs, (S, C) over the shared seeds and clips that all runs have a number of."""
    seeds, clips = shared
    sides = [
        np.array([runs[seed].by_clip(clips, mode, branch, metric) for seed in seeds])
        for runs, branch in zip((ours, theirs), branches, strict=True)
    ]
    matrix = (sides[0] - sides[1]).reshape(len(seeds), len(clips))
    return matrix[:, ~np.isnan(matrix).any(0)]


def _tested(differences: Mapping[Key, np.ndarray]) -> dict[Key, Effect]:
    """Effects of differences (S, C), those of one shape at once."""
    groups: dict[tuple[int, ...], list[Key]] = defaultdict(list)
    for key, matrix in differences.items():
        groups[matrix.shape].append(key)
    effects: dict[Key, Effect] = {}
    for (seeds, clips), keys in groups.items():
        numbers = np.stack(paired_effects(np.stack([differences[key] for key in keys]))[:4])
        for key, (mean, low, high, p) in zip(keys, numbers.T, strict=True):
            effects[key] = Effect(float(mean), _known(low), _known(high), _known(p), None, seeds, clips)
    corrected = holm(np.array([np.nan if effect.p is None else effect.p for effect in effects.values()]))
    return {
        key: replace(effect, holm=_known(p))
        for (key, effect), p in zip(effects.items(), corrected, strict=True)
    }


def _known(number: float) -> float | None:
    """The number; None for NaN."""
    return None if math.isnan(number) else float(number)


def _cost_effect(key: Key, ours: Runs, reference: Runs) -> dict[Key, Effect]:
    """The difference of mean costs, which has no interval: it is exact, or this machine's."""
    sides = [
        [run.costs[key.metric] for run in side.values() if key.metric in run.costs]
        for side in (ours, reference)
    ]
    return {key: Effect(float(np.mean(sides[0]) - np.mean(sides[1])))} if all(sides) else {}


def _shared(ours: Runs, reference: Runs) -> tuple[list[int], list[str]]:
    """The seeds that both have, and the clips that all their runs have."""
    seeds = [seed for seed in ours if seed in reference]
    names = [runs[seed].clips for runs in (ours, reference) for seed in seeds]
    return seeds, [name for name in names[0] if all(name in other for other in names)] if names else []


def _flags(sweep: Sweep, runs: Mapping[str, Runs], find: Find, command: str, compared: int) -> Iterable[str]:
    """What a reader has to know of these runs, a line each."""
    yield from _missing(sweep, runs, find, command)
    yield from _unequal_clips(sweep, runs)
    every = [(arm.label, run) for arm in sweep.runnable() for run in runs[arm.label].values()]
    for what in ("code", "data", "hardware"):
        yield from _differing(what, [(getattr(run.origin, what), label) for label, run in every])
    changed = [label for label, run in every if run.origin.changed]
    if changed:
        yield f"made by code with uncommitted changes: {_quoted(changed)}"
    if compared and max(len(found) for found in runs.values()) == 1:
        yield "one seed an arm: the intervals speak of other clips, not of other seeds"


def _missing(sweep: Sweep, runs: Mapping[str, Runs], find: Find, command: str) -> Iterable[str]:
    gaps = []
    for arm in sweep.runnable():
        seeds = [seed for seed in sweep.seeds if seed not in runs[arm.label]]
        if seeds:
            gaps.append(f"'{arm.label}' seed {', '.join(map(str, seeds))}{_state(arm, seeds, find)}")
    if gaps:
        yield f"missing: {_listed(gaps)}; fill with: {command}"


def _state(arm: Arm, seeds: Sequence[int], find: Find) -> str:
    """How far unfinished runs are, where they began."""
    found = [find(arm, seed) for seed in seeds]
    states = _unique(run.status for run in found if run is not None and run.status not in ("new", "done"))
    return f" ({', '.join(states)})" if states else ""


def _unequal_clips(sweep: Sweep, runs: Mapping[str, Runs]) -> Iterable[str]:
    reference = runs[sweep.reference]
    for arm in sweep.runnable():
        sides = [run.clips.keys() for side in (runs[arm.label], reference) for run in side.values()]
        every: set[str] = set().union(*sides)
        shared = every.intersection(*sides)
        if len(shared) < len(every) and runs[arm.label] and reference:
            yield (
                f"unequal test clips: '{arm.label}' and '{sweep.reference}' share {len(shared)} of "
                f"{len(every)}; only those are compared, the means are over all"
            )


def _differing(what: str, found: Iterable[tuple[str, str]]) -> Iterable[str]:
    """A line where arms differ in something, naming which have what."""
    groups: dict[str, list[str]] = defaultdict(list)
    for value, label in found:
        groups[value].append(label)
    if len(groups) > 1:
        parts = [f"{value} of {_quoted(labels)}" for value, labels in groups.items()]
        yield f"{what} differs: {'; '.join(parts)}"


def _unique(words: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(words))


def _quoted(labels: Iterable[str]) -> str:
    return _listed([f"'{label}'" for label in _unique(labels)])


def _listed(words: Sequence[str], most: int = 12) -> str:
    """Words with commas or, of many, the first ones and how many more."""
    return ", ".join(words[:most]) + (f", and {len(words) - most} more" if len(words) > most else "")
