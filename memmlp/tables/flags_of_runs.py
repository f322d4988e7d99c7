"""Flags: what a reader has to know about the runs behind a table, one line each."""

from __future__ import annotations

import itertools
import math
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from memmlp.common.processes import MIN_CORE_SHARE
from memmlp.runs.lookup import hardly_trained
from memmlp.sweep.definition import COSTS, TIMES, Sweep, Variant
from memmlp.tables import flags_of_code
from memmlp.tables.effects import RunsBySeed, control_variant, one_and_the_same
from memmlp.tables.flag_words import flags_of_difference, had_core, listed, quoted, unique
from memmlp.tables.measured_run import SHARED, UNKNOWN, Measured
from memmlp.tables.table import STEADY
from memmlp.tables.undisturbed_times import core_share, undisturbed

DescribeRun = Callable[[Variant, int], str | None]
BUILT_IN = "builtin"
ALIKE = 1.1  # how many times the frames of its control a variant may see in training before a flag says so
UNTIED = 0.75  # share of test clips that are groups of their own from which on a flag asks for groups
SMPLH = (1, 2, 3)  # the paper's tables on AMASS, on the rest joints of SMPL-H bodies
ORIGIN = {
    "code": "code", "data": "data", "hardware": "hardware", "device": "device", "gpu": "GPU",
    "threads": "threads", "processes": "processes", "torch": "torch", "precision": "precision",
}  # fmt: skip


def silent(variant: Variant, seed: int) -> None:
    """Return None, as there is nothing to say about a run: the default for a `DescribeRun`."""


def flags(
    sweep: Sweep,
    asked: Sweep,
    runs: Mapping[str, RunsBySeed],
    command: str,
    state: DescribeRun,
    older: DescribeRun,
) -> Iterable[str]:
    """Yield the flags of a table.

    Args:
        sweep: the sweep as it is shown.
        asked: the sweep before variants without the wanted branch fell back to another branch.
        runs: the finished runs of every runnable variant, by seed.
        command: the command that makes missing runs.
        state: describes in a word the state of a variant's and seed's unfinished run.
        older: names the run with an earlier recipe that exists in place of a missing one.
    """
    every = [(variant.label, run) for variant in sweep.runnable() for run in runs[variant.label].values()]
    yield from _other_data(sweep)
    yield from _missing(sweep, runs, command, state)
    yield from _older(sweep, runs, older)
    if set(sweep.metrics) - set(COSTS):
        yield from _branches(sweep, asked, runs, command)
    yield from _offline(every)
    yield from _same(sweep, runs)
    yield from _unequal_clips(sweep, runs)
    yield from _unequal_groups(every)
    yield from _fewer_seeds(sweep, runs)
    yield from _no_numbers(sweep, runs)
    if "Jitter" in sweep.metrics:
        yield from _calmer_than_truth(sweep, runs)
    if set(sweep.metrics) - set(COSTS):
        yield from _data_warnings(every, "resampled")
        yield from _data_warnings(every, "unusual")
    for attribute, what in ORIGIN.items():
        unknown = "none" if attribute == "gpu" else UNKNOWN
        values = [(getattr(run.origin, attribute), label) for label, run in every]
        yield from flags_of_difference(
            what, [(each.replace(UNKNOWN, unknown), label) for each, label in values]
        )
    yield from flags_of_code.other_files(every)
    yield from flags_of_code.older_code((label, run.code, run.origin.plugins) for label, run in every)
    if set(TIMES) & set(sweep.metrics):
        yield from flags_of_difference("machine of the times", _timed(every))
        yield from _busy(sweep, runs)
    if set(sweep.metrics) - set(COSTS):
        yield from _hardly_trained(every)
    yield from _seen(sweep, runs)
    yield from _partial(every)
    yield from _data_warnings(every, "divided")
    yield from flags_of_code.recipes(every)
    yield from flags_of_code.upstream_weights(every)
    yield from flags_of_code.own_code(every)
    uncommitted = [label for label, run in every if run.origin.changed]
    if uncommitted:
        yield f"made by code with uncommitted changes: {quoted(uncommitted)}"
    if set(sweep.metrics) - set(COSTS):
        yield from _replicates(sweep, runs)
        yield from _body(sweep, every)
        yield from _less_precise(every)


def _less_precise(every: Sequence[tuple[str, Measured]]) -> Iterable[str]:
    """Flag variants whose size and times come from another file than the network that was evaluated."""
    found = [label for label, run in every if run.origin.deployed != "fp32"]
    if found:
        yield f"size and times are of a file of less precision, errors of float32: {quoted(found)}"


def _other_data(sweep: Sweep) -> Iterable[str]:
    """Flag a table of the paper that names its data (a protocol on AMASS) but is shown for other data."""
    own, chosen = (
        next((word for word in reversed(words) if word.startswith("data=")), None)
        for words in (sweep.base, sweep.command_line)
    )
    if sweep.table and own and chosen and own != chosen:
        yield f"a table of {own}, shown with {chosen}: its errors do not compare with the paper's"


def _missing(sweep: Sweep, runs: Mapping[str, RunsBySeed], command: str, state: DescribeRun) -> Iterable[str]:
    """Flag the missing runs, with their states, and the command that makes them."""
    lacking: dict[str, str] = {}
    for variant in sweep.runnable():
        seeds = gaps(sweep, variant, runs)
        if seeds:
            states = unique(word for seed in seeds if (word := state(variant, seed)))
            words = f" ({', '.join(states)})" if states else ""
            lacking[variant.label] = f"seed {', '.join(map(str, seeds))}{words}"
    alike = 1 < len(sweep.runnable()) == len(lacking) and len(set(lacking.values())) == 1
    told = [f"'{label}' {gap}" for label, gap in lacking.items()]
    if lacking:
        every = f"every variant's {next(iter(lacking.values()))}"
        yield f"missing: {every if alike else listed(told)}; fill with: {command}"


def _older(sweep: Sweep, runs: Mapping[str, RunsBySeed], older: DescribeRun) -> Iterable[str]:
    """Flag missing runs for which a run with an earlier recipe exists."""
    found = [
        f"'{variant.label}' seed {seed} ({run})"
        for variant in sweep.runnable()
        for seed in gaps(sweep, variant, runs)
        if (run := older(variant, seed))
    ]
    if found:
        yield f"made by an earlier recipe, left out and made again by the sweep: {listed(found)}"


def early_looks(sweep: Sweep, runs: Mapping[str, RunsBySeed]) -> Iterable[str]:
    """Flag variants whose planned seeds are only partly finished.

    Testing them now and again later inflates the false-positive rate.
    """
    early = [
        variant.label
        for variant in sweep.runnable()
        if len(runs[variant.label]) > 1 and gaps(sweep, variant, runs)
    ]
    if early:
        yield (
            "not all seeds are there: a table that is looked at again as they come has a star by chance more "
            f"often than 1 in 20 (--until-decided counts its looks): {quoted(early)}"
        )


def gaps(sweep: Sweep, variant: Variant, runs: Mapping[str, RunsBySeed]) -> list[int]:
    """Return the seeds of a variant for which there is no run."""
    return [seed for seed in sweep.seeds_of(variant) if seed not in runs[variant.label]]


def _branches(sweep: Sweep, asked: Sweep, runs: Mapping[str, RunsBySeed], command: str) -> Iterable[str]:
    """Flag rows that show another branch than the table, and rows that were not evaluated in their branch."""
    wanted = {variant.label: variant.branch for variant in asked.variants}
    fallen = [variant for variant in sweep.runnable() if variant.branch != wanted[variant.label]]
    if fallen:
        labels, branches = (
            quoted(variant.label for variant in fallen),
            listed(unique(a.branch for a in fallen)),
        )
        yield f"the network has no other branch, so the row shows {branches}: {labels}"
    lacking = [a for a in sweep.runnable() if any(not run.has(a.branch) for run in runs[a.label].values())]
    if lacking:
        branches, labels = listed(unique(a.branch for a in lacking)), quoted(a.label for a in lacking)
        yield f"not evaluated in the branch {branches}: {labels}; do so with: {command}"


def _offline(every: Sequence[tuple[str, Measured]]) -> Iterable[str]:
    """Flag networks that can't run as a stream."""
    found = [label for label, run in every if run.origin.offline]
    if found:
        yield f"offline, no stream, for frames are made with later ones: {quoted(found)}"


def _unequal_clips(sweep: Sweep, runs: Mapping[str, RunsBySeed]) -> Iterable[str]:
    """Flag variants whose test clips differ from those of their controls."""
    for variant in sweep.runnable():
        other = control_variant(sweep, variant)
        if other is None:
            continue
        sides = [run.clips.keys() for one in (variant, other) for run in runs[one.label].values()]
        every: set[str] = set().union(*sides)
        shared = every.intersection(*sides)
        if len(shared) < len(every) and runs[variant.label] and runs[other.label]:
            yield (
                f"unequal test clips: '{variant.label}' and '{other.label}' share {len(shared)} of "
                f"{len(every)}; only those are compared, the means are over all"
            )


def _unequal_groups(every: Sequence[tuple[str, Measured]]) -> Iterable[str]:
    """Flag clips that belong to different groups in different runs."""
    groups: dict[str, set[str]] = defaultdict(set)
    for _, run in every:
        for clip in run.clips:
            groups[clip].add(run.group(clip))
    several = [clip for clip, names in groups.items() if len(names) > 1]
    if several:
        yield f"runs differ in the groups of test clips (data.split.groups): {quoted(several)}"


def _fewer_seeds(sweep: Sweep, runs: Mapping[str, RunsBySeed]) -> Iterable[str]:
    """Flag runs that were not measured by a metric in which other seeds of their variant were."""
    lacking: dict[tuple[str, int], list[str]] = defaultdict(list)
    for variant in sweep.runnable():
        found = runs[variant.label]
        modes = sorted({mode for run in found.values() for mode in run.means}) or [""]
        for metric, mode in itertools.product(sweep.metrics, modes):
            without = [seed for seed, run in found.items() if run.value(mode, variant.branch, metric) is None]
            for seed in without if len(without) < len(found) else ():
                lacking[variant.label, seed].append(metric)
    if lacking:
        words = [f"'{label}' seed {seed} ({listed(unique(m))})" for (label, seed), m in lacking.items()]
        yield f"not measured, so that the mean is of the other seeds: {listed(words)}"


def _no_numbers(sweep: Sweep, runs: Mapping[str, RunsBySeed]) -> Iterable[str]:
    """Flag runs that have no number for clips for which others have one, because their network diverged.

    A clip for which no run has a number is too short for the metric, unless it has no position error either.
    """
    lost: dict[tuple[str, int], set[str]] = defaultdict(set)
    every = [
        (variant, seed, run) for variant in sweep.runnable() for seed, run in runs[variant.label].items()
    ]
    modes = {mode for _, _, run in every for mode in run.means}
    for mode, metric in itertools.product(modes, set(sweep.metrics) - set(COSTS)):
        lacking = {
            (variant.label, seed): _lacking(run, mode, variant.branch, metric)
            for variant, seed, run in every
            if run.value(mode, variant.branch, metric) is not None
        }
        short = set.intersection(*lacking.values()) if lacking else set()
        short -= {
            clip
            for variant, _, run in every
            if run.value(mode, variant.branch, SHARED) is not None
            for clip in _lacking(run, mode, variant.branch, SHARED)
        }
        for cell, clips in lacking.items():
            lost[cell] |= clips - short
    found = [f"'{label}' seed {seed} ({len(clips)} clips)" for (label, seed), clips in lost.items() if clips]
    if found:
        left = "of clips that are left out of differences, whose verdicts so stay inconclusive"
        yield f"errors that are no numbers, {left}: {listed(found)}"


def _lacking(run: Measured, mode: str, branch: str, metric: str) -> set[str]:
    """Return the clips for which a run has no finite number."""
    names = list(run.clips)
    known = np.isfinite(run.by_clip(names, mode, branch, metric))
    if known.all():
        return set()
    return {name for name, there in zip(names, known, strict=True) if not there}


def _calmer_than_truth(sweep: Sweep, runs: Mapping[str, RunsBySeed]) -> Iterable[str]:
    """Flag variants whose motion has less jitter than the true one, as when a network hardly follows at all.

    Variants that were tested on other clips have another truth, and a line of their own.
    """
    calmer: dict[tuple[str, str], list[str]] = defaultdict(list)
    for variant in sweep.runnable():
        found = list(runs[variant.label].values())
        for mode in sorted({mode for run in found for mode in run.means}):
            made, true = (
                [value for run in found if (value := run.value(mode, variant.branch, metric)) is not None]
                for metric in ("Jitter", "GT Jitter")
            )
            made, true = (list(filter(math.isfinite, values)) for values in (made, true))
            if made and true and np.mean(made) < np.mean(true):
                calmer[mode, f"{np.mean(true):.2f}"].append(f"'{variant.label}' {np.mean(made):.2f}")
    for (mode, truth), variants in calmer.items():
        less = f"Jitter below the truth's {truth} ({mode}): {listed(variants)}"
        yield f"{less}; calmer than the motion itself is no better"


def _hardly_trained(every: Sequence[tuple[str, Measured]]) -> Iterable[str]:
    """Flag variants whose networks saw so little motion that their errors are those of the first weights."""
    found = [(label, hardly_trained(run.training.get("frames", 0.0))) for label, run in every]
    for said in unique(said for _, said in found):
        labels = unique(label for label, one in found if one == said)
        if said:
            which = "every variant" if len(labels) == len({label for label, _ in every}) else quoted(labels)
            yield f"{said}: {which}"


def _seen(sweep: Sweep, runs: Mapping[str, RunsBySeed]) -> Iterable[str]:
    """Flag variants that saw more or fewer frames in training than their controls, for whatever reason."""
    frames = {
        label: sorted(number for run in found.values() if (number := run.training.get("frames")))
        for label, found in runs.items()
    }
    unequal = []
    for variant in sweep.runnable():
        other = control_variant(sweep, variant)
        if other and frames[variant.label] and frames[other.label]:
            every = frames[variant.label] + frames[other.label]
            if max(every) > ALIKE * min(every):
                own, controls = (_in_millions(frames[one.label]) for one in (variant, other))
                unequal.append(f"'{variant.label}' {own} M to '{other.label}' {controls} M")
    if unequal:
        yield f"number of frames seen in training differs: {listed(unequal)}"


def _in_millions(numbers: Sequence[float]) -> str:
    """Return sorted numbers in millions: one where all read the same, or else the least and the most."""
    return "-".join(unique(f"{number / 1e6:.3g}" for number in (numbers[0], numbers[-1])))


def _timed(every: Sequence[tuple[str, Measured]]) -> list[tuple[str, str]]:
    """Return the machine on which each run's times were measured, where it is known, and the run's label."""
    found = [(run.origin.timed_on, label) for label, run in every if run.latency or run.costs]
    return [(machine, label) for machine, label in found if machine != UNKNOWN]


def _busy(sweep: Sweep, runs: Mapping[str, RunsBySeed]) -> Iterable[str]:
    """Flag variants whose times were measured while other work ran on the machine."""
    found, fewer = [], []
    for variant in sweep.runnable():
        counted = undisturbed(runs[variant.label])
        shares = [share for run in counted.values() if (share := core_share(run)) is not None]
        ratios = [run.costs["ratio"] for run in counted.values() if "ratio" in run.costs]
        if shares and min(shares) < MIN_CORE_SHARE:
            found.append(had_core(variant.label, min(shares)))
        elif ratios and max(ratios) > STEADY * min(ratios):
            found.append(f"'{variant.label}' (ratio {min(ratios):.3g} to {max(ratios):.3g} over seeds)")
        if len(counted) < len(runs[variant.label]):
            fewer.append(f"'{variant.label}' ({len(counted)} of {len(runs[variant.label])})")
    if found:
        yield f"timed on a busy machine, so that other work is in the times: {listed(found)}"
    if fewer:
        yield f"times are of the seeds that were timed with a core to themselves: {listed(fewer)}"


def _partial(every: Sequence[tuple[str, Measured]]) -> Iterable[str]:
    """Flag runs whose data is only a part of their protocol's list."""
    for part in unique(run.origin.partial for _, run in every if run.origin.partial):
        yield f"{part}, and no more: {quoted(label for label, run in every if run.origin.partial == part)}"


def _data_warnings(every: Sequence[tuple[str, Measured]], fact: str) -> Iterable[str]:
    """Flag runs by a warning about their data, of a field of their origins."""
    for said in unique(warning for _, run in every if (warning := getattr(run.origin, fact))):
        yield f"{said}: {quoted(label for label, run in every if getattr(run.origin, fact) == said)}"


def _replicates(sweep: Sweep, runs: Mapping[str, RunsBySeed]) -> Iterable[str]:
    """Flag that intervals don't cover seeds, groups of clips or VQ-VAEs, if there is only one of them."""
    measured = {label: list(found.values()) for label, found in runs.items() if found}
    if len(measured) < 2:
        return
    every = [run for found in measured.values() for run in found]
    groups = [len({run.group(clip) for clip in run.clips}) for run in every]
    one_seed, one_group = max(map(len, measured.values())) == 1, max(groups) == 1
    if one_seed and one_group:
        yield "one seed a variant and one group of test clips: no interval, and nothing is starred"
    elif one_seed:
        yield "one seed a variant: the intervals speak of other clips, not of other seeds; nothing is starred"
    else:
        yield from _single(sweep, runs, one_group)
    if max(groups) > 1 and all(_alone(run) >= UNTIED * len(run.clips) for run in every):
        alone, clips = min((_alone(run), len(run.clips)) for run in every if run.clips)
        each = f"{alone} of {clips} test clips are groups of their own"
        each = "each test clip is a group of its own" if alone == clips else each
        yield f"{each} (data.split.groups): right where none share a person"
    if one_group and not one_seed:
        yield "one group of test clips: the intervals speak of other seeds, not of other takes or people"
    shared = [label for label, found in measured.items() if _one_upstream(found)]
    if shared:
        yield f"all seeds share one VQ-VAE, which they so do not replicate: {quoted(shared)}"


def _alone(run: Measured) -> int:
    """Return how many of a run's test clips are groups of their own."""
    return list(Counter(map(run.group, run.clips)).values()).count(1)


def _same(sweep: Sweep, runs: Mapping[str, RunsBySeed]) -> Iterable[str]:
    """Flag variants that are the same run, because nothing distinguishes them under these overrides."""
    for variant in sweep.runnable():
        other = control_variant(sweep, variant)
        if other and one_and_the_same(variant, other, runs[variant.label], runs[other.label]):
            said = _apart(runs[variant.label], runs[other.label])
            yield f"'{variant.label}' and '{other.label}' are one run: {said}"


def _apart(ours: RunsBySeed, theirs: RunsBySeed) -> str:
    """Say in what two variants differ whose runs and errors are the same: in costs, or in nothing."""
    if any(ours[seed].costs != theirs[seed].costs for seed in ours.keys() & theirs.keys()):
        return "they differ in how it is deployed, and in nothing but costs"
    return "what tells them apart has no effect here"


def _single(sweep: Sweep, runs: Mapping[str, RunsBySeed], one_group: bool) -> Iterable[str]:
    """Flag comparisons over one seed where variants have more.

    They have an interval only if there are several groups of clips.
    """
    pairs = [
        (variant.label, other.label)
        for variant in sweep.runnable()
        if (other := control_variant(sweep, variant))
    ]
    shared = {one: len(runs[one].keys() & runs[two].keys()) for one, two in pairs}
    few = [label for label, number in shared.items() if number == 1]
    if few:
        so = "there is no interval" if one_group else "the interval speaks of other clips alone"
        yield f"one seed, so that {so}, and no star: {quoted(few)}"


def _one_upstream(found: Sequence[Measured]) -> bool:
    upstream = {run.origin.upstream for run in found}
    return len(found) > 1 and len(upstream) == 1 and None not in upstream


def _body(sweep: Sweep, every: Sequence[tuple[str, Measured]]) -> Iterable[str]:
    """Flag runs on the built-in skeleton in tables where the paper's numbers are on SMPL-H bodies."""
    bare = [label for label, run in every if run.origin.body == BUILT_IN]
    if sweep.table in SMPLH and bare:
        yield f"on the built-in skeleton, the paper's are on SMPL-H bodies (data.body=FILE): {quoted(bare)}"
