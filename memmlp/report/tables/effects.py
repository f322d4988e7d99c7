"""Differences of a table's variants from their controls, with intervals and verdicts."""

from __future__ import annotations

import itertools
import math
import statistics
from collections import defaultdict
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from memmlp.report.tables.measured_run import SHARED, Measured, select_measured
from memmlp.report.tables.statistics import (
    compute_detectable,
    compute_equivalence_p,
    correct_by_holm,
    count_needed_seeds,
    decide,
    estimate_paired_effects,
)
from memmlp.report.tables.table import STEADY, Effect, Key
from memmlp.sweep.definition import COSTS, MODES, TIMES, Sweep, Variant

RunsBySeed = Mapping[int, Measured]  # a variant's finished runs by seed


class Paired(NamedTuple):
    """A variant's differences from its control.

    Attributes:
        matrix: the variant's errors minus the control's (S, C), by seed and clip.
        groups: the number of each clip's group (C,).
        diverged: whether further clips were lost because a network diverged on them.
    """

    matrix: np.ndarray
    groups: np.ndarray
    diverged: bool = False

    @property
    def testable(self) -> bool:
        """Whether there is a p-value: with several seeds and groups of clips, and no clip lost to divergence.

        What is left after a divergence is too easy a test of the network that diverged.
        """
        return len(self.matrix) > 1 and len(set(self.groups)) > 1 and not self.diverged


def find_control(sweep: Sweep, variant: Variant) -> Variant | None:
    """Return a variant's control; None for the sweep's control and for rows with only the paper's values."""
    label = sweep.control_of(variant) if variant.overrides is not None else None
    return next((other for other in sweep.variants if other.label == label), None)


def list_comparisons(sweep: Sweep) -> Iterator[tuple[Variant, Variant]]:
    """Yield each variant that has a control, with its control."""
    for variant in sweep.runnable():
        other = find_control(sweep, variant)
        if other is not None:
            yield variant, other


def find_paper_effect(sweep: Sweep, variant: Variant, metric: str) -> float | None:
    """Return the paper's difference from the control, from printed values; None if one is not printed."""
    other = find_control(sweep, variant)
    ours = (variant.paper or {}).get(metric)
    theirs = (other.paper or {}).get(metric) if other else None
    return None if ours is None or theirs is None else round(ours - theirs, 6)


def pair_differences(
    sweep: Sweep, runs: Mapping[str, RunsBySeed], modes: Sequence[str], labels: Container[str] | None = None
) -> dict[Key, Paired]:
    """Return the differences in all error metrics for all variants, or for those with the given labels."""
    found = {}
    for variant, other in list_comparisons(sweep):
        ours, theirs = runs[variant.label], runs[other.label]
        seeds = [seed for seed in ours if seed in theirs]
        if (labels is not None and variant.label not in labels) or not seeds:
            continue
        if show_same_errors(variant, other, ours, theirs):
            continue
        sides = [[side[seed] for seed in seeds] for side in (ours, theirs)]
        every = [*sides[0], *sides[1]]
        clips = [name for name in every[0].clips if all(name in run.clips for run in every)]
        names = np.array([every[0].group(clip) for clip in clips], dtype=str)
        groups = np.unique(names, return_inverse=True)[1]
        for mode, metric in itertools.product(modes, sweep.metrics):
            evaluated = all(any(mode in errors for errors in run.clips.values()) for run in every)
            if metric not in COSTS and evaluated:
                branches = (variant.branch, other.branch)
                pair = _paired(sides, clips, groups, branches, mode, metric)
                found[Key(variant.label, mode, metric)] = pair
    return {key: pair for key, pair in found.items() if pair.matrix.size}


def compute_effects(sweep: Sweep, runs: Mapping[str, RunsBySeed], modes: Sequence[str]) -> dict[Key, Effect]:
    """Return the effects of all variants, with p-values corrected over all of them.

    For costs there are only the differences, without p-values.
    """
    printed = {
        Key(variant.label, mode, metric): find_paper_effect(sweep, variant, metric)
        for variant, mode, metric in itertools.product(sweep.runnable(), modes, sweep.metrics)
    }
    return _costs(sweep, runs, modes) | _judged(
        estimate_effects(pair_differences(sweep, runs, modes), sweep.smallest, sensitivity=True),
        sweep.smallest,
        printed,
    )


def show_same_errors(variant: Variant, other: Variant, ours: RunsBySeed, theirs: RunsBySeed) -> bool:
    """Return whether two variants show the same errors of the same run, so that there is nothing to compare.

    One run may have several kinds of errors, such as those after two kinds of inverse kinematics.
    """
    if variant.branch != other.branch:
        return False
    both = [(ours[seed], theirs[seed]) for seed in ours.keys() & theirs.keys()]
    # As texts, in which NaN equals NaN.
    same = [pair for pair in both if pair[0].id == pair[1].id]
    shown = [[str(run.shown(variant.branch)) for run in pair] for pair in same]
    return any(one == two for one, two in shown)


def _paired(
    sides: Sequence[Sequence[Measured]],
    clips: Sequence[str],
    groups: np.ndarray,
    branches: tuple[str, str],
    mode: str,
    metric: str,
) -> Paired:
    """Return ours minus theirs over the clips for which all runs have a number.

    Args:
        sides: the runs of both variants, by seed.
        clips: the clips that all runs have (C).
        groups: their groups (C,).
        branches: the branches of both variants.
    """

    def errors(metric: str) -> np.ndarray:
        """Return a metric of both sides (2, S, C)."""
        found = [
            [run.by_clip(clips, mode, branch, metric) for run in side]
            for side, branch in zip(sides, branches, strict=True)
        ]
        return np.array(found).reshape(2, len(sides[0]), len(clips))

    values = errors(metric)
    known = np.isfinite(values).all((0, 1))
    diverged = not known.all() and _diverged(values, errors(SHARED))
    own, others = values[:, :, known]
    return Paired(own - others, groups[known], diverged)


def _diverged(values: np.ndarray, positions: np.ndarray) -> bool:
    """Return whether a network diverged on a clip for which a metric has no number, rather than a short clip.

    A clip is too short if no run has a number for it, although all have a position error.

    Args:
        values: the metric (2, S, C) of both sides.
        positions: their position errors (2, S, C); runs without any tell nothing.
    """
    known, placed = np.isfinite(values), np.isfinite(positions)
    measured = placed.any(2, keepdims=True)
    lost = known.any((0, 1)) | (measured & ~placed).any((0, 1))
    return bool((lost & ~known.all((0, 1))).any())


def estimate_effects(
    pairs: Mapping[Key, Paired], smallest: Mapping[str, float], sensitivity: bool
) -> dict[Key, Effect]:
    """Return the effects with their own p-values, not corrected yet, in the order of the pairs.

    Args:
        pairs: the differences.
        smallest: the smallest effect of interest of each metric.
        sensitivity: whether the effects that such tables would find are wanted, which take as long as the
            rest.
    """
    found: dict[Key, Effect] = {}
    comparisons = max(1, count_testable(pairs))  # with none, nothing computed by it is shown
    # Those of equal seeds and groups are computed at once.
    batches: dict[tuple[int, bytes], list[Key]] = defaultdict(list)
    for key, pair in pairs.items():
        batches[len(pair.matrix), pair.groups.tobytes()].append(key)
    for keys in batches.values():
        differences, groups = np.stack([pairs[key].matrix for key in keys]), pairs[keys[0]].groups
        size = {"seeds": differences.shape[1], "clips": differences.shape[2], "groups": len(set(groups))}
        margins = np.array([smallest.get(key.metric, np.nan) for key in keys])
        same = compute_equivalence_p(differences, margins, groups)
        nothing = np.full(len(keys), np.nan)
        seen = compute_detectable(differences, comparisons, groups) if sensitivity else nothing
        numbers = estimate_paired_effects(differences, groups)
        columns = zip(keys, numbers.mean, numbers.low, numbers.high, numbers.p, same, seen, strict=True)
        for key, mean, low, high, p, equal, least in columns:
            values = {"low": low, "high": high}
            values |= {"p": p, "equal": equal, "detectable": least} if pairs[key].testable else {}
            known: dict[str, Any] = {name: or_none(number) for name, number in values.items()}
            found[key] = Effect(float(mean), **known, **size)
    return {key: found[key] for key in pairs}


def count_testable(pairs: Mapping[Key, Paired]) -> int:
    """Return how many comparisons have a p-value, so that Holm's correction is over them."""
    return sum(pair.testable for pair in pairs.values())


class NeededSeeds(NamedTuple):
    """How many seeds a comparison needs to find an effect of the paper's size with a power of 80 %.

    Attributes:
        key: the comparison.
        paper: the paper's difference.
        measured: the measured mean difference.
        seeds: the number of seeds so far.
        needed: the number of seeds needed; None if no number is enough with these clips.
    """

    key: Key
    paper: float
    measured: float
    seeds: int
    needed: int | None


def compute_needed_seeds(
    sweep: Sweep, runs: Mapping[str, RunsBySeed], modes: Sequence[str]
) -> list[NeededSeeds]:
    """Return the seeds needed by all testable comparisons whose effect the paper prints.

    The correction is over the testable comparisons of both modes, as in the table.
    """
    shown = use_existing_branches(sweep, runs)
    pairs, variants = pair_differences(shown, runs, MODES), {one.label: one for one in shown.variants}
    found = []
    for key, pair in pairs.items():
        effect = find_paper_effect(shown, variants[key.label], key.metric)
        if effect and key.mode in modes and pair.testable:
            needed = count_needed_seeds(pair.matrix, effect, count_testable(pairs), pair.groups)
            found.append(NeededSeeds(key, effect, float(pair.matrix.mean()), len(pair.matrix), needed))
    return found


def _judged(
    tested: Mapping[Key, Effect], smallest: Mapping[str, float], printed: Mapping[Key, float | None]
) -> dict[Key, Effect]:
    """Return the effects with verdicts and corrected p-values.

    P-values of differences are corrected by Holm over all comparisons; those of equivalences are, too, as a
    separate family.
    """
    keys = list(tested)
    different = correct_by_holm(np.array([or_nan(tested[key].p) for key in keys]))
    equal = correct_by_holm(np.array([or_nan(tested[key].equal) for key in keys]))
    judged = {}
    for key, p, q in zip(keys, different, equal, strict=True):
        said = decide(float(p), float(q), tested[key].mean, printed.get(key))
        judged[key] = replace(tested[key], holm=or_none(p), equal=or_none(q), verdict=said)
    return judged


def _costs(sweep: Sweep, runs: Mapping[str, RunsBySeed], modes: Sequence[str]) -> dict[Key, Effect]:
    """Return the differences of mean costs, without intervals: costs are exact, or hold for this machine.

    A time's effect says whether it differs beyond the noise of times.
    """

    found = {}
    for variant, other in list_comparisons(sweep):
        for mode, metric in itertools.product(modes, set(sweep.metrics) & set(COSTS)):
            sides = [compute_mean_cost(runs[one.label], metric) for one in (variant, other)]
            if not any(math.isnan(side) for side in sides):
                noise = metric in TIMES and max(sides) < STEADY * min(sides)
                found[Key(variant.label, mode, metric)] = Effect(sides[0] - sides[1], within_noise=noise)
    return found


def compute_mean_cost(runs: RunsBySeed, metric: str) -> float:
    """Return a cost's mean over the runs that count for it; NaN if none has it."""
    costs = [run.costs[metric] for run in select_measured(metric, runs).values() if metric in run.costs]
    return statistics.mean(costs) if costs else math.nan  # the mean of equal costs is exactly their value


def or_none(number: float) -> float | None:
    """Return the number; None for NaN."""
    return None if math.isnan(number) else float(number)


def or_nan(number: float | None) -> float:
    """Return the number; NaN for None."""
    return math.nan if number is None else number


def use_existing_branches(sweep: Sweep, runs: Mapping[str, RunsBySeed]) -> Sweep:
    """Return the sweep with the rotation branch for variants whose networks have no other.

    A network without a position branch may still have been evaluated after inverse kinematics.
    """

    def single(variant: Variant) -> bool:
        found = runs.get(variant.label, {}).values()
        solved = variant.branch == "combined" and all(run.has("combined") for run in found)
        return bool(found) and not solved and all(run.one_branch for run in found)

    variants = (replace(one, branch="rotation") if single(one) else one for one in sweep.variants)
    return replace(sweep, variants=tuple(variants))
