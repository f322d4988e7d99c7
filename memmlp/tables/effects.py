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

from memmlp.sweep.definition import COSTS, TIMES, Sweep, Variant
from memmlp.tables.measured_run import SHARED, Measured
from memmlp.tables.statistics import detectable, equivalence_p, holm, paired_effects, verdict
from memmlp.tables.table import STEADY, Effect, Key
from memmlp.tables.undisturbed_times import measured_for

RunsBySeed = Mapping[int, Measured]  # a variant's finished runs by seed


class SharedClips(NamedTuple):
    """The seeds and clips that a variant's runs share with those of its control.

    Attributes:
        seeds: the seeds that both variants have (S).
        clips: the names of the clips that all runs have (C).
        group_names: the names of the clips' groups (C).
        groups: the groups' numbers (C,).
    """

    seeds: list[int]
    clips: list[str]
    group_names: list[str]
    groups: np.ndarray


class Paired(NamedTuple):
    """A variant's differences from its control.

    Attributes:
        matrix: the variant's errors minus the control's (S, C), by seed and clip.
        groups: the number of each clip's group (C,).
        clips: the names of these clips (C).
        group_names: the names of their groups (C).
        diverged: whether further clips were lost because a network diverged on them.
    """

    matrix: np.ndarray
    groups: np.ndarray
    clips: tuple[str, ...] = ()
    group_names: tuple[str, ...] = ()
    diverged: bool = False

    @property
    def testable(self) -> bool:
        """Whether there is a p-value: with several seeds and groups of clips, and no clip lost to divergence.

        What is left after a divergence is too easy a test of the network that diverged.
        """
        return len(self.matrix) > 1 and len(set(self.groups)) > 1 and not self.diverged


def control_variant(sweep: Sweep, variant: Variant) -> Variant | None:
    """Return a variant's control; None for the sweep's control and for rows with only the paper's values."""
    label = sweep.control_of(variant) if variant.overrides is not None else None
    return next((other for other in sweep.variants if other.label == label), None)


def paper_effect(sweep: Sweep, variant: Variant, metric: str) -> float | None:
    """Return the paper's difference from the control, from printed values; None if one is not printed."""
    other = control_variant(sweep, variant)
    ours = (variant.paper or {}).get(metric)
    theirs = (other.paper or {}).get(metric) if other else None
    return None if ours is None or theirs is None else round(ours - theirs, 6)


def paired(
    sweep: Sweep, runs: Mapping[str, RunsBySeed], modes: Sequence[str], labels: Container[str] | None = None
) -> dict[Key, Paired]:
    """Return the differences in all error metrics for all variants, or for those with the given labels."""
    found = {}
    for variant, other in _compared(sweep):
        if labels is not None and variant.label not in labels:
            continue
        ours, theirs = runs[variant.label], runs[other.label]
        if one_and_the_same(variant, other, ours, theirs):
            continue
        shared = _shared(ours, theirs)
        every = [runs[seed] for runs in (ours, theirs) for seed in shared.seeds]
        seen = [mode for mode in modes if all(_has_mode(run, mode) for run in every)]
        for mode, metric in itertools.product(seen, sweep.metrics):
            if metric not in COSTS:
                branches = (variant.branch, other.branch)
                found[Key(variant.label, mode, metric)] = _paired(
                    ours, theirs, shared, branches, mode, metric
                )
    return {key: pair for key, pair in found.items() if pair.matrix.size}


def _has_mode(run: Measured, mode: str) -> bool:
    """Return whether a run was evaluated in a mode, on any clip."""
    return any(mode in errors for errors in run.clips.values())


def effects(sweep: Sweep, runs: Mapping[str, RunsBySeed], modes: Sequence[str]) -> dict[Key, Effect]:
    """Return the effects of all variants, with p-values corrected over all of them.

    For costs there are only the differences, without p-values.
    """
    printed = {
        Key(variant.label, mode, metric): paper_effect(sweep, variant, metric)
        for variant, mode, metric in itertools.product(sweep.runnable(), modes, sweep.metrics)
    }
    return _costs(sweep, runs, modes) | _judged(
        tested(paired(sweep, runs, modes), sweep.smallest, sensitivity=True), sweep.smallest, printed
    )


def one_and_the_same(variant: Variant, other: Variant, ours: RunsBySeed, theirs: RunsBySeed) -> bool:
    """Return whether two variants show the same errors of the same run, so that there is nothing to compare.

    One run may have several kinds of errors, such as those after two kinds of inverse kinematics.
    """

    def same(one: Measured, two: Measured) -> bool:
        return one.id == two.id and str(one.shown(variant.branch)) == str(
            two.shown(other.branch)
        )  # NaN is NaN

    shared = any(same(ours[seed], theirs[seed]) for seed in ours.keys() & theirs.keys())
    return shared and variant.branch == other.branch


def _compared(sweep: Sweep) -> Iterator[tuple[Variant, Variant]]:
    """Yield each variant that has a control, with its control."""
    for variant in sweep.runnable():
        other = control_variant(sweep, variant)
        if other is not None:
            yield variant, other


def _paired(
    ours: RunsBySeed,
    theirs: RunsBySeed,
    shared: SharedClips,
    branches: tuple[str, str],
    mode: str,
    metric: str,
) -> Paired:
    """Return ours minus theirs, over the shared seeds and the clips for which all runs have a number."""
    seeds, clips, group_names, groups = shared

    def errors(metric: str) -> np.ndarray:
        """Return a metric of both sides (2, S, C)."""
        found = [
            [runs[seed].by_clip(clips, mode, branch, metric) for seed in seeds]
            for runs, branch in zip((ours, theirs), branches, strict=True)
        ]
        return np.array(found).reshape(2, len(seeds), len(clips))

    values = errors(metric)
    known = np.isfinite(values).all((0, 1))
    diverged = not known.all() and _diverged(values, errors(SHARED))
    own, others = values[:, :, known]
    left, their_groups = (tuple(itertools.compress(words, known)) for words in (clips, group_names))
    return Paired(own - others, groups[known], left, their_groups, diverged)


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


def _shared(ours: RunsBySeed, theirs: RunsBySeed) -> SharedClips:
    """Return the seeds and clips that a variant and its control share."""
    seeds = [seed for seed in ours if seed in theirs]
    known = [runs[seed].clips for runs in (ours, theirs) for seed in seeds]
    clips = [name for name in known[0] if all(name in other for other in known)] if known else []
    names = [ours[seeds[0]].group(clip) for clip in clips]
    return SharedClips(seeds, clips, names, np.unique(np.array(names, dtype=str), return_inverse=True)[1])


def alike(pairs: Mapping[Key, Paired]) -> Iterator[tuple[list[Key], np.ndarray, np.ndarray]]:
    """Group comparisons with the same number of seeds and the same groups of clips, to be computed at once.

    Yields:
        Keys (K), differences (K, S, C), and the clips' groups (C,), which the comparisons share.
    """
    batches: dict[tuple[int, bytes], list[Key]] = defaultdict(list)
    for key, pair in pairs.items():
        batches[len(pair.matrix), pair.groups.tobytes()].append(key)
    for keys in batches.values():
        yield keys, np.stack([pairs[key].matrix for key in keys]), pairs[keys[0]].groups


def tested(
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
    comparisons = max(1, testable(pairs))  # with none, nothing computed by it is shown
    for keys, differences, groups in alike(pairs):
        size = {"seeds": differences.shape[1], "clips": differences.shape[2], "groups": len(set(groups))}
        margins = np.array([smallest.get(key.metric, np.nan) for key in keys])
        same = equivalence_p(differences, margins, groups)
        nothing = np.full(len(keys), np.nan)
        seen = detectable(differences, comparisons, groups) if sensitivity else nothing
        numbers = paired_effects(differences, groups)
        columns = zip(keys, numbers.mean, numbers.low, numbers.high, numbers.p, same, seen, strict=True)
        for key, mean, low, high, p, equal, least in columns:
            words = {"low": low, "high": high}
            words |= {"p": p, "equal": equal, "detectable": least} if pairs[key].testable else {}
            known: dict[str, Any] = {name: or_none(number) for name, number in words.items()}
            found[key] = Effect(float(mean), **known, **size)
    return {key: found[key] for key in pairs}


def testable(pairs: Mapping[Key, Paired]) -> int:
    """Return how many comparisons have a p-value, so that Holm's correction is over them."""
    return sum(pair.testable for pair in pairs.values())


def _judged(
    tested: Mapping[Key, Effect], smallest: Mapping[str, float], printed: Mapping[Key, float | None]
) -> dict[Key, Effect]:
    """Return the effects with verdicts and corrected p-values.

    P-values of differences are corrected by Holm over all comparisons; those of equivalences are, too, as a
    separate family.
    """
    keys = list(tested)
    different = holm(np.array([or_nan(tested[key].p) for key in keys]))
    equal = holm(np.array([or_nan(tested[key].equal) for key in keys]))
    judged = {}
    for key, p, q in zip(keys, different, equal, strict=True):
        said = verdict(float(p), float(q), tested[key].mean, printed.get(key))
        judged[key] = replace(tested[key], holm=or_none(p), equal=or_none(q), verdict=said)
    return judged


def _costs(sweep: Sweep, runs: Mapping[str, RunsBySeed], modes: Sequence[str]) -> dict[Key, Effect]:
    """Return the differences of mean costs, without intervals: costs are exact, or hold for this machine.

    Of times it is said whether they differ beyond what they do by themselves.
    """
    found = {}
    for variant, other in _compared(sweep):
        for mode, metric in itertools.product(modes, set(sweep.metrics) & set(COSTS)):
            sides = [_mean_cost(runs[one.label], metric) for one in (variant, other)]
            if not any(math.isnan(side) for side in sides):
                noise = metric in TIMES and max(sides) < STEADY * min(sides)
                found[Key(variant.label, mode, metric)] = Effect(sides[0] - sides[1], within_noise=noise)
    return found


def _mean_cost(runs: RunsBySeed, metric: str) -> float:
    costs = [run.costs[metric] for run in measured_for(metric, runs).values() if metric in run.costs]
    return statistics.mean(costs) if costs else math.nan  # equal costs have themselves as their mean


def or_none(number: float) -> float | None:
    """Return the number; None for NaN."""
    return None if math.isnan(number) else float(number)


def or_nan(number: float | None) -> float:
    """Return the number; NaN for None."""
    return math.nan if number is None else number


def with_existing_branches(sweep: Sweep, runs: Mapping[str, RunsBySeed]) -> Sweep:
    """Return the sweep with the rotation branch for variants whose networks have no other.

    A network without a position branch may still have been evaluated after inverse kinematics.
    """

    def single(variant: Variant) -> bool:
        found = runs.get(variant.label, {}).values()
        solved = variant.branch == "combined" and all(run.has("combined") for run in found)
        return bool(found) and not solved and all(run.one_branch for run in found)

    variants = tuple(
        replace(variant, branch="rotation") if single(variant) else variant for variant in sweep.variants
    )
    return replace(sweep, variants=variants)
