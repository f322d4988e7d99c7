"""Differences of a table's variants from their controls, with intervals and verdicts."""

import itertools
import math
import statistics
from collections import defaultdict
from collections.abc import Collection, Container, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from memmlp.report.tables.measured_run import SHARED_METRIC, MeasuredRun, select_runs_for_metric
from memmlp.report.tables.statistics import (
    average_groups,
    compute_bootstrap_p,
    compute_detectable,
    compute_equivalence_p,
    correct_by_holm,
    count_needed_seeds,
    decide_verdict,
    estimate_interval,
    estimate_paired_effects,
)
from memmlp.report.tables.table import MAX_TIME_RATIO, Effect, Key
from memmlp.sweep.definition import BRANCHES, COSTS, MODES, TIMES, Sweep, Variant

RunsBySeed = Mapping[int, MeasuredRun]  # a variant's finished runs by seed


class PairedDifferences(NamedTuple):
    """A variant's differences from its control.

    Attributes:
        matrix: the variant's errors minus the control's errors (S, C), by seed and clip.
        groups: the index of each clip's group (C,).
        diverged: whether clips were removed because a network diverged on them.
    """

    matrix: np.ndarray
    groups: np.ndarray
    diverged: bool = False

    @property
    def is_testable(self) -> bool:
        """Whether a p-value can be computed: it needs several seeds, several clip groups and no divergence.

        After a divergence, the remaining clips would favour the network that diverged.
        """
        return len(self.matrix) > 1 and len(set(self.groups)) > 1 and not self.diverged


def find_control(sweep: Sweep, variant: Variant) -> Variant | None:
    """Return a variant's control; None if it is the control itself, or only has the paper's values."""
    label = sweep.find_control(variant) if variant.overrides is not None else None
    return next((other for other in sweep.variants if other.label == label), None)


def list_comparisons(sweep: Sweep) -> Iterator[tuple[Variant, Variant]]:
    """Yield each variant that has a control, with its control."""
    for variant in sweep.list_runnable():
        if other := find_control(sweep, variant):
            yield variant, other


def find_paper_effect(sweep: Sweep, variant: Variant, metric: str) -> float | None:
    """Return the paper's value for a variant minus its value for the control; None if one is missing."""
    other = find_control(sweep, variant)
    ours = (variant.paper or {}).get(metric)
    theirs = (other.paper or {}).get(metric) if other else None
    return None if ours is None or theirs is None else round(ours - theirs, 6)


def pair_differences(
    sweep: Sweep, runs: Mapping[str, RunsBySeed], modes: Sequence[str], labels: Container[str] | None = None
) -> dict[Key, PairedDifferences]:
    """Return differences in all error metrics, for all variants or only for the given labels."""
    found = {}
    for variant, other in list_comparisons(sweep):
        ours, theirs = runs[variant.label], runs[other.label]
        seeds = [seed for seed in ours if seed in theirs]
        if (labels is not None and variant.label not in labels) or not seeds:
            continue
        if have_same_errors(variant, other, ours, theirs):
            continue
        sides = [[side[seed] for seed in seeds] for side in (ours, theirs)]
        every = [*sides[0], *sides[1]]
        clips = [name for name in every[0].clips if all(name in run.clips for run in every)]
        names = np.array([every[0].get_group(clip) for clip in clips], dtype=str)
        groups = np.unique(names, return_inverse=True)[1]
        for mode, metric in itertools.product(modes, sweep.metrics):
            evaluated = all(any(mode in errors for errors in run.clips.values()) for run in every)
            if metric not in COSTS and evaluated:
                branches = (variant.branch, other.branch)
                pair = _subtract_control(sides, clips, groups, branches, mode, metric)
                found[Key(variant.label, mode, metric)] = pair
    return {key: pair for key, pair in found.items() if pair.matrix.size}


def compute_effects(
    sweep: Sweep, runs: Mapping[str, RunsBySeed], modes: Sequence[str], sensitivity: bool = True
) -> dict[Key, Effect]:
    """Return the effects of all variants, with p-values corrected for all comparisons.

    Effects on costs have no p-values. `sensitivity` is that of `estimate_effects`.
    """
    printed = {
        Key(variant.label, mode, metric): find_paper_effect(sweep, variant, metric)
        for variant, mode, metric in itertools.product(sweep.list_runnable(), modes, sweep.metrics)
    }
    errors = estimate_effects(pair_differences(sweep, runs, modes), sweep.smallest, sensitivity)
    return _compare_costs(sweep, runs, modes) | _add_verdicts(errors, printed)


def compare_branches(
    sweep: Sweep, runs: Mapping[str, RunsBySeed], modes: Sequence[str]
) -> dict[str, dict[Key, Effect]]:
    """Return the effects with variant and control in the same branch, by branch.

    Comparisons that the sweep itself makes in this branch are left out, and positions of two networks without
    a position branch. Each branch has its own correction. The paper's effect is that of the printed branch.
    """
    pairs = {variant.label: (variant, other) for variant, other in list_comparisons(sweep)}
    one_branch = {
        label: bool(runs[label]) and all(run.has_one_branch for run in runs[label].values()) for label in runs
    }
    found = {}
    for branch in BRANCHES:
        changed = replace(sweep, variants=tuple(replace(one, branch=branch) for one in sweep.variants))
        effects = compute_effects(changed, runs, modes, sensitivity=False)
        shown = {
            label
            for label, (variant, other) in pairs.items()
            if {variant.branch, other.branch} != {branch}
            and not (branch == "position" and one_branch[label] and one_branch[other.label])
        }
        found[branch] = {key: one for key, one in effects.items() if one.seeds and key.label in shown}
    return found


def have_same_errors(variant: Variant, other: Variant, ours: RunsBySeed, theirs: RunsBySeed) -> bool:
    """Return whether two variants have the same errors from the same run, so a comparison is pointless.

    A run may have several sets of errors, for example from two inverse kinematics solvers.
    """
    if variant.branch != other.branch:
        return False
    both = [(ours[seed], theirs[seed]) for seed in ours.keys() & theirs.keys()]
    branch = variant.branch  # its means are compared as texts, because NaN differs from NaN
    return any(
        one.id == two.id and str(one.get_branch_means(branch)) == str(two.get_branch_means(branch))
        for one, two in both
    )


def _subtract_control(
    sides: Sequence[Sequence[MeasuredRun]],
    clips: Sequence[str],
    groups: np.ndarray,
    branches: tuple[str, str],
    mode: str,
    metric: str,
) -> PairedDifferences:
    """Return the variant's errors minus the control's, on the clips for which all runs have a number.

    `sides` and `branches` are those of the variant and of the control, with runs in the order of the seeds.
    `clips` (C) are the clips that all runs have, `groups` (C,) their group indices.
    """

    def collect_errors(metric: str) -> np.ndarray:
        """Return a metric of the variant and of the control (2, S, C)."""
        errors = [
            [run.get_clip_values(clips, mode, branch, metric) for run in side]
            for side, branch in zip(sides, branches, strict=True)
        ]
        return np.array(errors).reshape(2, len(sides[0]), len(clips))

    values = collect_errors(metric)
    known = np.isfinite(values).all((0, 1))
    diverged = not known.all() and _has_diverged(values, collect_errors(SHARED_METRIC))
    own, others = values[:, :, known]
    return PairedDifferences(own - others, groups[known], diverged)


def _has_diverged(values: np.ndarray, positions: np.ndarray) -> bool:
    """Return whether a network diverged on a clip without a number for a metric.

    The other explanation is a clip that is too short for the metric. Then no run has a number for the clip,
    but all runs have a position error. `values` and `positions` are the metric and the position errors of
    variant and control (2, S, C). Runs with only NaN as position errors are ignored.
    """
    known, placed = np.isfinite(values), np.isfinite(positions)
    measured = placed.any(2, keepdims=True)
    lost = known.any((0, 1)) | (measured & ~placed).any((0, 1))
    return bool((lost & ~known.all((0, 1))).any())


def estimate_effects(
    pairs: Mapping[Key, PairedDifferences], smallest: Mapping[str, float], sensitivity: bool
) -> dict[Key, Effect]:
    """Return the effects with uncorrected p-values, in the order of the pairs.

    Args:
        pairs: the differences.
        smallest: the smallest effect of interest by metric.
        sensitivity: whether to compute detectable effects and bootstrap p-values, which take the most time.
    """
    found: dict[Key, Effect] = {}
    comparisons = max(1, count_testable(pairs))
    # Comparisons with equal seeds and groups are computed in one batch.
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
        second = compute_bootstrap_p(differences, groups) if sensitivity else nothing
        mean, low, high, p = estimate_paired_effects(differences, groups)
        above = (average_groups(differences, groups)[0].mean(1) > 0).sum(1)
        tested = np.where([pairs[key].is_testable for key in keys], [p, second, same, seen], np.nan)
        names = ("low", "high", "p", "bootstrap", "equal", "detectable")
        for key, difference, count, *row in zip(keys, mean, above, low, high, *tested, strict=True):
            known: dict[str, Any] = dict(zip(names, map(convert_nan_to_none, row), strict=True))
            found[key] = Effect(float(difference), groups_above=int(count), **known, **size)
    return {key: found[key] for key in pairs}


def estimate_mean_interval(
    runs: Sequence[MeasuredRun], mode: str, branch: str, metric: str
) -> tuple[float | None, float | None]:
    """Return the 95 % interval of a metric's mean over seeds and clip groups, from the runs of a variant.

    It is None with a single seed and group, or if the runs differ in their clips with a value.
    """
    clips = list(runs[0].clips)
    if any(run.clips.keys() != runs[0].clips.keys() for run in runs):
        return None, None
    values = np.array([run.get_clip_values(clips, mode, branch, metric) for run in runs])
    known = np.isfinite(values[0])
    if not known.any() or (np.isfinite(values) != known).any():
        return None, None
    groups = [runs[0].get_group(clip) for clip in itertools.compress(clips, known)]
    low, high = estimate_interval(values[None][:, :, known], groups)
    return convert_nan_to_none(low[0]), convert_nan_to_none(high[0])


def count_testable(pairs: Mapping[Key, PairedDifferences]) -> int:
    """Count the comparisons with a p-value, for Holm's correction."""
    return sum(pair.is_testable for pair in pairs.values())


class NeededSeeds(NamedTuple):
    """The number of seeds that detects an effect of the paper's size with a power of 80 %.

    Attributes:
        key: the comparison.
        paper: the paper's difference.
        measured: the measured mean difference.
        seeds: the number of seeds so far.
        needed: the number of seeds needed; None if more seeds do not help.
    """

    key: Key
    paper: float
    measured: float
    seeds: int
    needed: int | None


def compute_needed_seeds(
    sweep: Sweep, runs: Mapping[str, RunsBySeed], modes: Sequence[str]
) -> list[NeededSeeds]:
    """Return how many seeds each testable comparison with an effect in the paper needs to detect it.

    As in the table, the correction for multiple comparisons includes both modes.
    """
    shown = use_existing_branches(sweep, runs)
    pairs, variants = pair_differences(shown, runs, MODES), {one.label: one for one in shown.variants}
    found = []
    for key, pair in pairs.items():
        effect = find_paper_effect(shown, variants[key.label], key.metric)
        if effect and key.mode in modes and pair.is_testable:
            needed = count_needed_seeds(pair.matrix, effect, count_testable(pairs), pair.groups)
            found.append(NeededSeeds(key, effect, float(pair.matrix.mean()), len(pair.matrix), needed))
    return found


def _add_verdicts(tested: Mapping[Key, Effect], printed: Mapping[Key, float | None]) -> dict[Key, Effect]:
    """Return the effects with verdicts and corrected p-values.

    Holm's correction treats differences and equivalences as separate families of p-values.
    """
    p, second, equal = collect_p_values(tested.values(), ("p", "bootstrap", "equal"))
    # Comparisons without a bootstrap p-value still count in its correction.
    corrected_second = correct_by_holm(np.where(np.isnan(second), p, second))
    corrected_second[np.isnan(second)] = np.nan
    families = correct_by_holm(p), corrected_second, correct_by_holm(equal)
    judged = {}
    for (key, effect), *corrected in zip(tested.items(), *families, strict=True):
        verdict = decide_verdict(corrected[0], corrected[2], effect.mean, printed.get(key))
        holm, other, same = map(convert_nan_to_none, corrected)
        judged[key] = replace(effect, holm=holm, bootstrap=other, equal=same, verdict=verdict)
    return judged


def collect_p_values(effects: Collection[Effect], names: Sequence[str]) -> np.ndarray:
    """Return p-values (n, K) of K effects by the names of their fields; NaN for None."""
    return np.array([[getattr(effect, name) for effect in effects] for name in names], float)


def _compare_costs(sweep: Sweep, runs: Mapping[str, RunsBySeed], modes: Sequence[str]) -> dict[Key, Effect]:
    """Return differences of mean costs, without intervals."""
    found = {}
    for variant, other in list_comparisons(sweep):
        for mode, metric in itertools.product(modes, set(sweep.metrics) & set(COSTS)):
            sides = [compute_mean_cost(runs[one.label], metric) for one in (variant, other)]
            if not any(math.isnan(side) for side in sides):
                noise = metric in TIMES and max(sides) < MAX_TIME_RATIO * min(sides)
                found[Key(variant.label, mode, metric)] = Effect(sides[0] - sides[1], within_noise=noise)
    return found


def compute_mean_cost(runs: RunsBySeed, metric: str) -> float:
    """Return a cost's mean over the runs that `select_runs_for_metric` selects; NaN without a value."""
    counted = select_runs_for_metric(metric, runs).values()
    costs = [run.costs[metric] for run in counted if metric in run.costs]
    return statistics.mean(costs) if costs else math.nan  # the mean of equal costs is exactly their value


def convert_nan_to_none(number: float) -> float | None:
    return None if math.isnan(number) else float(number)


def use_existing_branches(sweep: Sweep, runs: Mapping[str, RunsBySeed]) -> Sweep:
    """Switch variants to the rotation branch if their networks have no other branch.

    Exception: the branch "combined" remains if such a network was evaluated after inverse kinematics.
    """

    def has_one_branch(variant: Variant) -> bool:
        found = runs.get(variant.label, {}).values()
        solved = variant.branch == "combined" and all(run.has_branch("combined") for run in found)
        return bool(found) and not solved and all(run.has_one_branch for run in found)

    variants = (replace(one, branch="rotation") if has_one_branch(one) else one for one in sweep.variants)
    return replace(sweep, variants=tuple(variants))
