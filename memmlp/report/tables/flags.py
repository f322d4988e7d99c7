"""Flags: warnings about the runs behind a table, in one line each."""

import functools
import itertools
import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

import numpy as np

from memmlp.common.processes import MIN_CORE_FRACTION
from memmlp.report.tables.effects import RunsBySeed, have_same_errors, list_comparisons
from memmlp.report.tables.measured_run import (
    SHARED_METRIC,
    UNKNOWN,
    MeasuredRun,
    find_core_fraction,
    select_undisturbed_runs,
)
from memmlp.report.tables.table import MAX_TIME_RATIO
from memmlp.runs.environment import compute_code_digests, list_differing_files
from memmlp.runs.lookup import warn_if_hardly_trained
from memmlp.sweep.definition import COSTS, TIMES, Sweep, Variant

DescribeRun = Callable[[Variant, int], str | None]
LabelledRuns = Sequence[tuple[str, MeasuredRun]]
"""Pairs of variant label and finished run."""

BUILT_IN_BODY = "builtin"
MAX_TRAINING_RATIO = 1.1  # maximum ratio of training frames between variant and control without a flag
MAX_BUDGET_ERROR = 0.05  # maximum relative difference of compute from its budget without a flag
UNGROUPED_FRACTION = 0.75  # fraction of ungrouped test clips from which a flag asks for groups
SMPLH_TABLES = (1, 2, 3)  # the paper's tables on AMASS, which use SMPL-H bodies
MAX_FILES = 5  # maximum number of file names in a flag
ORIGIN = {
    "code": "code", "data": "data", "hardware": "hardware", "device": "device", "gpu": "GPU",
    "threads": "threads", "processes": "processes", "torch": "torch", "precision": "precision",
}  # fmt: skip


def find_flags(
    sweep: Sweep,
    requested: Sweep,
    runs: Mapping[str, RunsBySeed],
    command: str,
    describe_run: DescribeRun,
) -> Iterator[str]:
    """Yield the flags of a table.

    Args:
        sweep: the shown sweep.
        requested: the sweep as in its file; in `sweep`, branches that runs lack are replaced.
        runs: the finished runs of every runnable variant, by seed.
        command: the command that makes missing runs.
        describe_run: describes the state of an unfinished run.
    """
    every = [
        (variant.label, run) for variant in sweep.list_runnable() for run in runs[variant.label].values()
    ]
    has_errors = bool(set(sweep.metrics) - set(COSTS))
    yield from _flag_other_data(sweep)
    yield from flag_missing_runs(sweep, runs, command, describe_run)
    if has_errors:
        yield from _flag_branches(sweep, requested, runs, command)
    if offline := [label for label, run in every if run.origin.offline]:
        yield f"offline: uses future frames: {join_quoted(offline)}"
    yield from _flag_variants_sharing_runs(sweep, runs)
    yield from _flag_unequal_clips(sweep, runs)
    yield from _flag_unequal_groups(every)
    yield from _flag_unmeasured_seeds(sweep, runs)
    yield from _flag_diverged_runs(sweep, runs)
    if "Jitter" in sweep.metrics:
        yield from _flag_smoother_than_truth(sweep, runs)
    if has_errors:
        yield from _flag_data_warnings(every, "resampled")
        yield from _flag_data_warnings(every, "unusual")
    for attribute, what in ORIGIN.items():
        unknown = "none" if attribute == "gpu" else UNKNOWN
        values = [(getattr(run.origin, attribute).replace(UNKNOWN, unknown), label) for label, run in every]
        yield from _flag_differences(what, values)
    yield from flag_older_code((label, run.code, run.origin.plugins) for label, run in every)
    if set(TIMES) & set(sweep.metrics):
        timed = [(run.origin.timed_on, label) for label, run in every if run.costs]
        yield from _flag_differences("machine of the times", [one for one in timed if one[0] != UNKNOWN])
        yield from _flag_busy_machine(sweep, runs)
    if has_errors:
        yield from _flag_short_training(every)
    yield from _flag_unequal_training(sweep, runs)
    yield from _flag_missed_budgets(every)
    yield from _flag_data_warnings(every, "partial", "trained on a part of the data: ")
    yield from _flag_data_warnings(every, "divided")
    yield from _flag_data_warnings(every, "imported")
    yield from _flag_unequal_versions(every)
    if uncommitted := [label for label, run in every if run.origin.changed]:
        yield f"made by code with uncommitted changes: {join_quoted(uncommitted)}"
    if has_errors:
        yield from _flag_missing_replicates(sweep, runs)
        yield from _flag_bodies_and_precision(sweep, every)


def flag_early_tables(sweep: Sweep, runs: Mapping[str, RunsBySeed]) -> Iterator[str]:
    """Flag variants with only part of their planned seeds.

    A test now and another test later inflate the false-positive rate.
    """
    several = [one for one in sweep.list_runnable() if len(runs[one.label]) > 1]
    if early := [one.label for one in several if find_missing_seeds(sweep, one, runs)]:
        yield (
            "seeds are missing: repeated tests as they come give false positives more often than 1 in 20 "
            f"(--until-decided corrects for this): {join_quoted(early)}"
        )


def find_missing_seeds(sweep: Sweep, variant: Variant, runs: Mapping[str, RunsBySeed]) -> list[int]:
    """Return a variant's planned seeds without a finished run."""
    return [seed for seed in sweep.get_seeds(variant) if seed not in runs[variant.label]]


def flag_older_code(runs: Iterable[tuple[str, Mapping[str, str], Iterable[str]]]) -> Iterator[str]:
    """Flag runs whose code has changed since, under the same component versions.

    Args:
        runs: for each run, the variant's label, code digests (`compute_code_digests`; empty if unknown) and
            the names of custom packages.
    """
    current = functools.cache(compute_code_digests)
    found = [
        (label, list_differing_files(code, current(tuple(packages))))
        for label, code, packages in runs
        if code
    ]
    names = sorted({name for _, files in found for name in files})
    if names:
        labels = join_quoted(label for label, files in found if files)
        since = "has changed since these runs, under the same component versions"
        yield f"code of {join_first(names, MAX_FILES)} {since}: {labels}"


def _flag_differences(name: str, labelled_values: Iterable[tuple[str, str]]) -> Iterator[str]:
    """Flag a property with a name if its values, each with a variant's label, differ between variants."""
    groups: dict[str, list[str]] = defaultdict(list)
    for value, label in labelled_values:
        groups[value].append(label)
    if len(groups) > 1:
        parts = [f"{value} of {join_quoted(labels)}" for value, labels in groups.items()]
        yield f"{name} differs: {'; '.join(parts)}"


def drop_repeats(texts: Iterable[str]) -> list[str]:
    """Return the texts in order, without repetitions."""
    return list(dict.fromkeys(texts))


def join_quoted(labels: Iterable[str]) -> str:
    """Quote labels, and join them with commas, without repetitions (`join_first`)."""
    return join_first([f"'{label}'" for label in drop_repeats(labels)])


def join_first(texts: Sequence[str], max_count: int = 12) -> str:
    """Join at most `max_count` texts with commas, followed by the number of omitted texts."""
    more = f", and {len(texts) - max_count} more" if len(texts) > max_count else ""
    return ", ".join(texts[:max_count]) + more


def _flag_other_data(sweep: Sweep) -> Iterator[str]:
    """Flag a table of the paper that is shown for other data than the data in its sweep file."""
    own, chosen = (
        next((text for text in reversed(texts) if text.startswith("data=")), None)
        for texts in (sweep.base, sweep.command_line)
    )
    if sweep.table and own and chosen and own != chosen:
        yield f"a table of {own}, shown with {chosen}: errors are not comparable with the paper"


def flag_missing_runs(
    sweep: Sweep, runs: Mapping[str, RunsBySeed], command: str, describe_run: DescribeRun
) -> Iterator[str]:
    """Flag the planned seeds of variants without a finished run. `describe_run` tells a run's state."""
    lacking: dict[str, list[str]] = defaultdict(list)
    for variant in sweep.list_runnable():
        if seeds := find_missing_seeds(sweep, variant, runs):
            states = drop_repeats(text for seed in seeds if (text := describe_run(variant, seed)))
            described = f" ({', '.join(states)})" if states else ""
            lacking[f"seed {', '.join(map(str, seeds))}{described}"].append(variant.label)
    if lacking:
        gap, labels = next(iter(lacking.items()))
        alike = 1 < len(sweep.list_runnable()) == len(labels)
        gaps = join_first([f"{join_quoted(labels)} {gap}" for gap, labels in lacking.items()])
        gaps = f"every variant's {gap}" if alike else gaps
        yield f"missing: {gaps}; fill with: {command}"


def _flag_branches(
    sweep: Sweep, requested: Sweep, runs: Mapping[str, RunsBySeed], command: str
) -> Iterator[str]:
    wanted = {variant.label: variant.branch for variant in requested.variants}
    other = [one for one in sweep.list_runnable() if one.branch != wanted[one.label]]
    if other:
        yield f"the network has no other branch, so the row shows {_list_branches(other)}"
    every = [(one, run) for one in sweep.list_runnable() for run in runs[one.label].values()]
    if lacking := [one for one, run in every if not run.has_branch(one.branch)]:
        yield f"not evaluated in the branch {_list_branches(lacking)}; evaluate with: {command}"


def _list_branches(variants: Sequence[Variant]) -> str:
    branches = join_first(drop_repeats(one.branch for one in variants))
    return f"{branches}: {join_quoted(one.label for one in variants)}"


def _flag_variants_sharing_runs(sweep: Sweep, runs: Mapping[str, RunsBySeed]) -> Iterator[str]:
    """Flag pairs of variants that are the same run under these overrides."""
    for variant, other in list_comparisons(sweep):
        ours, theirs = runs[variant.label], runs[other.label]
        if have_same_errors(variant, other, ours, theirs):
            reason = "the difference between them has no effect here"
            if any(ours[seed].costs != theirs[seed].costs for seed in ours.keys() & theirs.keys()):
                reason = "they differ only in deployment and costs"
            yield f"'{variant.label}' and '{other.label}' are one run: {reason}"


def _flag_unequal_clips(sweep: Sweep, runs: Mapping[str, RunsBySeed]) -> Iterator[str]:
    for variant, other in list_comparisons(sweep):
        sides = [run.clips.keys() for one in (variant, other) for run in runs[one.label].values()]
        every: set[str] = set().union(*sides)
        shared = every.intersection(*sides)
        if len(shared) < len(every) and runs[variant.label] and runs[other.label]:
            yield (
                f"unequal test clips: '{variant.label}' and '{other.label}' share {len(shared)} of "
                f"{len(every)}; only those are compared"
            )


def _flag_unequal_groups(labelled_runs: LabelledRuns) -> Iterator[str]:
    groups: dict[str, set[str]] = defaultdict(set)
    for _, run in labelled_runs:
        for clip in run.clips:
            groups[clip].add(run.get_group(clip))
    if several := [clip for clip, names in groups.items() if len(names) > 1]:
        yield f"runs differ in the groups of test clips (data.split.groups): {join_quoted(several)}"


def _flag_unmeasured_seeds(sweep: Sweep, runs: Mapping[str, RunsBySeed]) -> Iterator[str]:
    """Flag runs without a metric that other seeds of the same variant have."""
    lacking: dict[tuple[str, int], list[str]] = defaultdict(list)
    for variant in sweep.list_runnable():
        found = runs[variant.label]
        modes = sorted({mode for run in found.values() for mode in run.means}) or [""]
        for metric, mode in itertools.product(sweep.metrics, modes):
            without = [s for s, run in found.items() if run.get_value(mode, variant.branch, metric) is None]
            for seed in without if len(without) < len(found) else ():
                lacking[variant.label, seed].append(metric)
    if lacking:
        texts = [
            f"'{label}' seed {seed} ({join_first(drop_repeats(m))})" for (label, seed), m in lacking.items()
        ]
        yield f"not measured, so the mean uses only the other seeds: {join_first(texts)}"


def _flag_diverged_runs(sweep: Sweep, runs: Mapping[str, RunsBySeed]) -> Iterator[str]:
    """Flag runs whose network diverged on clips.

    Such a run has no number for a clip. If no run has a number, the clip is too short for the metric, unless
    it has no position error either.
    """
    lost: dict[tuple[str, int], set[str]] = defaultdict(set)
    every = [
        (variant, seed, run) for variant in sweep.list_runnable() for seed, run in runs[variant.label].items()
    ]
    modes = {mode for _, _, run in every for mode in run.means}

    def find_clips_without_values(mode: str, metric: str) -> dict[tuple[str, int], set[str]]:
        """Return the clips without a finite number, by variant label and seed, for runs with the metric."""
        found = {}
        for variant, seed, run in every:
            if run.get_value(mode, variant.branch, metric) is not None:
                known = np.isfinite(run.get_clip_values(list(run.clips), mode, variant.branch, metric))
                found[variant.label, seed] = set(itertools.compress(run.clips, ~known))
        return found

    for mode, metric in itertools.product(modes, set(sweep.metrics) - set(COSTS)):
        lacking = find_clips_without_values(mode, metric)
        if any(lacking.values()):
            short = set.intersection(*lacking.values())
            short = short.difference(*find_clips_without_values(mode, SHARED_METRIC).values())
            for cell, clips in lacking.items():
                lost[cell] |= clips - short
    found = [f"'{label}' seed {seed} ({len(clips)} clips)" for (label, seed), clips in lost.items() if clips]
    if found:
        cells = join_first(found)
        yield f"NaN errors on clips, left out of differences, so verdicts stay inconclusive: {cells}"


def _flag_smoother_than_truth(sweep: Sweep, runs: Mapping[str, RunsBySeed]) -> Iterator[str]:
    """Flag variants whose predicted motion has less jitter than the true motion.

    Variants that were tested on different clips are flagged in separate lines.
    """
    smoother: dict[tuple[str, str], list[str]] = defaultdict(list)
    for variant in sweep.list_runnable():
        found = list(runs[variant.label].values())
        for mode in sorted({mode for run in found for mode in run.means}):
            predicted, truth = (
                np.array([run.get_value(mode, variant.branch, metric) for run in found], float)
                for metric in ("Jitter", "GT Jitter")
            )
            predicted, truth = predicted[np.isfinite(predicted)], truth[np.isfinite(truth)]
            if predicted.size and truth.size and predicted.mean() < truth.mean():
                text = f"'{variant.label}' {predicted.mean():.2f}"
                smoother[mode, f"{truth.mean():.2f}"].append(text)
    for (mode, jitter), texts in smoother.items():
        less = f"Jitter below the truth's {jitter} ({mode}): {join_first(texts)}"
        yield f"{less}; motion that is smoother than the truth is not better"


def _flag_short_training(labelled_runs: LabelledRuns) -> Iterator[str]:
    found = [(label, warn_if_hardly_trained(run.training.get("frames", 0.0))) for label, run in labelled_runs]
    for warning in drop_repeats(warning for _, warning in found if warning):
        labels = drop_repeats(label for label, one in found if one == warning)
        every_variant = len(labels) == len({label for label, _ in labelled_runs})
        yield f"{warning}: {'every variant' if every_variant else join_quoted(labels)}"


def _flag_unequal_training(sweep: Sweep, runs: Mapping[str, RunsBySeed]) -> Iterator[str]:
    frames = {
        label: sorted(number for run in found.values() if (number := run.training.get("frames")))
        for label, found in runs.items()
    }

    def format_millions(label: str) -> str:
        limits = frames[label][0], frames[label][-1]
        return "-".join(drop_repeats(f"{number / 1e6:.3g}" for number in limits))

    unequal = []
    for variant, other in list_comparisons(sweep):
        budgets = {run.training.get("budget") for one in (variant, other) for run in runs[one.label].values()}
        if len(budgets) == 1 and None not in budgets:
            continue  # equal compute
        both = frames[variant.label] + frames[other.label]
        if frames[variant.label] and frames[other.label] and max(both) > MAX_TRAINING_RATIO * min(both):
            ours, theirs = format_millions(variant.label), format_millions(other.label)
            unequal.append(f"'{variant.label}' {ours} M to '{other.label}' {theirs} M")
    if unequal:
        yield f"number of frames seen in training differs: {join_first(unequal)}"


def _flag_missed_budgets(every: LabelledRuns) -> Iterator[str]:
    """Flag trainings whose compute differs from `optim.tflop`, because a few steps cannot match it."""
    missed = {
        label: f"'{label}' {run.training['tflop']:.3g} instead of {budget:g}"
        for label, run in every
        if (budget := run.training.get("budget"))
        and not abs(run.training.get("tflop", math.nan) / budget - 1) <= MAX_BUDGET_ERROR
    }
    if missed:
        yield f"training compute differs from optim.tflop, TFLOP: {join_first(list(missed.values()))}"


def _flag_busy_machine(sweep: Sweep, runs: Mapping[str, RunsBySeed]) -> Iterator[str]:
    busy, fewer = [], []
    for variant in sweep.list_runnable():
        label, counted = variant.label, select_undisturbed_runs(runs[variant.label])
        fractions = [one for run in counted.values() if (one := find_core_fraction(run)) is not None]
        ratios = [run.costs["ratio"] for run in counted.values() if "ratio" in run.costs]
        if fractions and min(fractions) < MIN_CORE_FRACTION:
            busy.append(f"'{label}' (had a core for {100 * min(fractions):.0f} % of the time)")
        elif ratios and max(ratios) > MAX_TIME_RATIO * min(ratios):
            busy.append(f"'{label}' (ratio {min(ratios):.3g} to {max(ratios):.3g} over seeds)")
        if len(counted) < len(runs[label]):
            fewer.append(f"'{label}' ({len(counted)} of {len(runs[label])})")
    if busy:
        yield f"timed on a busy machine, so that other work is in the times: {join_first(busy)}"
    if fewer:
        yield f"times are of the seeds that were timed with a core to themselves: {join_first(fewer)}"


def _flag_data_warnings(labelled_runs: LabelledRuns, field: str, begin: str = "") -> Iterator[str]:
    for warning in drop_repeats(text for _, run in labelled_runs if (text := getattr(run.origin, field))):
        labels = join_quoted(label for label, run in labelled_runs if getattr(run.origin, field) == warning)
        yield f"{begin}{warning}: {labels}"


def _flag_unequal_versions(labelled_runs: LabelledRuns) -> Iterator[str]:
    versions = [(run.origin.every_version, label) for label, run in labelled_runs]
    for name in sorted({name for known, _ in versions for name in known}):
        having = [(str(known[name]), label) for known, label in versions if name in known]
        yield from _flag_differences(f"component version of {name}", having)
    weights: dict[str, list[tuple[str, str]]] = defaultdict(list)
    for label, run in labelled_runs:
        for prerequisite, digests in run.origin.prerequisite_weights.items():
            weights[prerequisite] += [(digest, label) for digest in digests.split(", ")]
    for prerequisite, having in weights.items():  # trained again, or on another machine
        yield from _flag_differences(f"digest of the weights of prerequisite run {prerequisite}", having)
    for name in sorted({name for _, run in labelled_runs for name in run.origin.plugins}):
        plugins = [(run.origin.plugins, label) for label, run in labelled_runs]
        having = [(known[name], label) for known, label in plugins if name in known]
        yield from _flag_differences(f"code of {name}", having)


def _flag_bodies_and_precision(sweep: Sweep, labelled_runs: LabelledRuns) -> Iterator[str]:
    bare = [label for label, run in labelled_runs if run.origin.body == BUILT_IN_BODY]
    if sweep.table in SMPLH_TABLES and bare:
        yield f"on the built-in skeleton; the paper uses SMPL-H bodies (data.body=FILE): {join_quoted(bare)}"
    less_precise = [label for label, run in labelled_runs if run.origin.deployed != "fp32"]
    if less_precise:
        labels = join_quoted(less_precise)
        yield f"size and times are for a file with less precision, errors are for float32: {labels}"


def _flag_missing_replicates(sweep: Sweep, runs: Mapping[str, RunsBySeed]) -> Iterator[str]:
    """Flag intervals that do not cover seeds, clip groups or VQ-VAEs, because there is only one."""
    measured = {label: list(found.values()) for label, found in runs.items() if found}
    if len(measured) < 2:
        return
    every = [run for found in measured.values() for run in found]
    one_seed = max(map(len, measured.values())) == 1
    one_group = max(len({run.get_group(clip) for clip in run.clips}) for run in every) == 1
    if one_seed and one_group:
        yield "one seed a variant and one group of test clips: no interval, and nothing is significant"
    elif one_seed:
        about = "the intervals are about other clips, not about other seeds"
        yield f"one seed a variant: {about}, and nothing is significant"
    else:
        pairs = [(one.label, two.label) for one, two in list_comparisons(sweep)]
        if few := [one for one, two in pairs if len(runs[one].keys() & runs[two].keys()) == 1]:
            interval = "no interval" if one_group else "an interval about other clips alone"
            yield f"one seed, so {interval}, and nothing is significant: {join_quoted(few)}"
    own = [run for run in every if run.clips and not run.clips_are_groups]
    sizes = [(Counter(map(run.get_group, run.clips)), len(run.clips)) for run in own]
    counts = [(list(groups.values()).count(1), clips) for groups, clips in sizes]
    if counts and not one_group and all(alone >= UNGROUPED_FRACTION * clips for alone, clips in counts):
        alone, clips = min(counts)
        each = f"{alone} of {clips} test clips are groups of their own"
        each = "each test clip is a group of its own" if alone == clips else each
        yield f"{each} (data.split.groups): right if no two share a person"
    if one_group and not one_seed:
        yield "one group of test clips: the intervals are about other seeds, not about other takes or people"
    several = {label: found for label, found in measured.items() if len(found) > 1}
    used = {label: {run.origin.prerequisite for run in found} for label, found in several.items()}
    if one_vqvae := [label for label, ids in used.items() if len(ids) == 1 and None not in ids]:
        yield f"all seeds share one VQ-VAE, so they do not replicate it: {join_quoted(one_vqvae)}"
