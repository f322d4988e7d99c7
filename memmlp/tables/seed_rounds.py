"""Rounds of seeds for variants with open verdicts: looks that are fixed in advance, and what they decided.

Every variant goes through the same looks (interim analyses), each at a number of seeds that was fixed at the
start. A variant whose comparisons are all decided gets no further looks. A look uses the first seeds of a
variant and of its control, whatever other seeds exist, and what it decides is final. It spends its level over
all comparisons of the sweep about which nothing has been claimed, including those of variants that are at
another look. So the levels add up to 5 % for either family of claims, even if a variant is late because its
runs failed (docs/statistics.md).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from memmlp.sweep.definition import COSTS, MODES, Sweep, Variant
from memmlp.tables.effects import (
    RunsBySeed,
    control_variant,
    or_nan,
    or_none,
    paired,
    paper_effect,
    tested,
    with_existing_branches,
)
from memmlp.tables.statistics import Verdict, looks, seeds_needed, sequential, spending, verdict
from memmlp.tables.table import Effect, Key

MOST = 13  # the largest number of seeds of a variant by default


@dataclass(frozen=True)
class Finding:
    """The finding of a look on one comparison.

    Attributes:
        label, mode, metric: which comparison it is.
        verdict: the verdict, final unless it is inconclusive.
        mean: the mean difference.
        p: its p-value; None with one group of clips, or where a network diverged on a clip: no number of
            seeds can decide the comparison.
        holm: the corrected p-value of the difference, to be compared with the look's level.
        equal: the corrected p-value of equivalence, to be compared with the look's level.
    """

    label: str
    mode: str
    metric: str
    verdict: Verdict
    mean: float
    p: float | None
    holm: float | None
    equal: float | None

    @property
    def key(self) -> Key:
        """The key of the comparison."""
        return Key(self.label, self.mode, self.metric)

    @property
    def inconclusive(self) -> bool:
        """Whether more seeds can decide the comparison: it is inconclusive, and was tested.

        A comparison without a p-value, such as that of a variant with too few runs, waits for other reasons.
        """
        return self.verdict is Verdict.INCONCLUSIVE and self.p is not None


@dataclass(frozen=True)
class Look:
    """A look that was taken.

    Attributes:
        seeds: how many seeds of each variant were looked at.
        level: the level that the look spent.
        runs: by the label of each variant that was looked at, a digest of the variant's runs and its
            control's.
        found: the findings on the comparisons that were inconclusive before.
    """

    seeds: int
    level: float
    runs: Mapping[str, str]
    found: tuple[Finding, ...]


@dataclass(frozen=True)
class Rounds:
    """The rounds of a sweep.

    Attributes:
        subject: what the verdicts depend on (`subject`).
        seeds: all seeds that may be spent, in order.
        looks: the number of seeds at each look.
        levels: the level that each look spends.
        taken: the looks that were taken.
    """

    subject: Mapping[str, Any]
    seeds: tuple[int, ...]
    looks: tuple[int, ...]
    levels: tuple[float, ...]
    taken: tuple[Look, ...] = ()

    def position(self, label: str) -> int:
        """Return how many looks a variant has been through."""
        return sum(label in look.runs for look in self.taken)

    def latest(self) -> dict[Key, tuple[Finding, Look]]:
        """Return the last finding on each comparison, with its look; decided ones were decided there."""
        return {finding.key: (finding, look) for look in self.taken for finding in look.found}

    def next_looks(self, sweep: Sweep) -> dict[str, int]:
        """Return, by label, the number (from 0) of the next look of each variant that has one.

        A variant has a next look while looks are left, and it has an inconclusive comparison or had no look
        yet.
        """
        going = {finding.label for finding, _ in self.latest().values() if finding.inconclusive}
        found = {variant.label: self.position(variant.label) for variant, _ in _compared(sweep)}
        return {
            label: number
            for label, number in found.items()
            if number < len(self.looks) and (number == 0 or label in going)
        }

    def counts(self, sweep: Sweep) -> dict[str, int]:
        """Return how many seeds each variant is to be trained with.

        This is the number of its latest or next look, or of such a look of a variant that is compared with
        it, whichever is larger.
        """
        ahead = self.next_looks(sweep)
        found = {variant.label: self.looks[0] for variant in sweep.runnable()}
        for variant, other in _compared(sweep):
            number = ahead.get(variant.label, self.position(variant.label) - 1)
            for label in (variant.label, other.label):
                found[label] = max(found[label], self.looks[number])
        return found

    def spent(self, sweep: Sweep) -> Sweep:
        """Return the sweep with seeds for each variant: those spent so far and those of its next look."""
        counts = self.counts(sweep)
        variants = tuple(
            replace(variant, seeds=self.seeds[: counts[variant.label]])
            if variant.label in counts
            else variant
            for variant in sweep.variants
        )
        return replace(sweep, variants=variants, seeds=self.seeds[: max(counts.values())])

    def family(self, sweep: Sweep) -> list[Key]:
        """Return all comparisons: those with findings and, for variants without a look, all possible ones."""
        new = [variant for variant, _ in _compared(sweep) if not self.position(variant.label)]
        return list(
            dict.fromkeys([*self.latest(), *(key for variant in new for key in _keys(sweep, variant))])
        )

    def unseen(self, sweep: Sweep) -> list[Key]:
        """Return the comparisons without findings, for variants that were looked at.

        Their runs have no numbers, or are one and the same.
        """
        looked = [variant for variant, _ in _compared(sweep) if self.position(variant.label)]
        return [key for variant in looked for key in _keys(sweep, variant) if key not in self.latest()]

    def judged(self, effects: Mapping[Key, Effect]) -> dict[Key, Effect]:
        """Return the effects with the looks' verdicts in place of verdicts from a fixed number of seeds."""
        latest = self.latest()
        return {
            key: _as_found(effect, *latest.get(key, (None, None))) if effect.verdict else effect
            for key, effect in effects.items()
        }


def subject(sweep: Sweep) -> dict[str, Any]:
    """Return what the verdicts depend on, in types for JSON; it must not change between two looks."""
    return {
        "variants": {
            variant.label: {
                "branch": variant.branch,
                "against": sweep.control_of(variant),
                "paper": {metric: paper_effect(sweep, variant, metric) for metric in sweep.metrics},
            }
            for variant in sweep.runnable()
        },
        "metrics": list(sweep.metrics),
        "smallest": {name: sweep.smallest[name] for name in sweep.metrics if name in sweep.smallest},
    }


def new_rounds(sweep: Sweep, most: int = MOST) -> Rounds:
    """Return new rounds of a sweep with at most `most` seeds.

    The sweep's own seeds come first, then the whole numbers that follow the largest of them.
    """
    following = itertools.count(max(sweep.seeds) + 1)
    seeds = tuple(itertools.islice(itertools.chain(sweep.seeds, following), most))
    schedule = looks(most)
    return Rounds(subject(sweep), seeds, schedule, spending(len(schedule)))


def advanced(
    rounds: Rounds, sweep: Sweep, runs: Mapping[str, RunsBySeed], named: Mapping[str, str]
) -> Rounds:
    """Return the rounds after the next look that can be taken; the same rounds if none can be.

    A look at a variant can be taken when the variant and its control have all seeds of its next look. If runs
    failed, variants may be at different looks; variants at an earlier look then come first.

    Args:
        rounds: the rounds so far.
        sweep: the sweep with which the rounds began.
        runs: the finished runs by label and seed.
        named: by label, a digest of the runs of a variant and its control up to its next look.
    """
    numbers = rounds.next_looks(sweep)
    ready = [label for label, number in numbers.items() if _ready(rounds, sweep, runs, label, number)]
    if not ready:
        return rounds
    number = min(numbers[label] for label in ready)
    labels = [label for label in ready if numbers[label] == number]
    look = Look(rounds.looks[number], rounds.levels[number], {label: named[label] for label in labels}, ())
    found = _found(rounds, sweep, runs, look)
    return replace(rounds, taken=(*rounds.taken, replace(look, found=tuple(found))))


def outlook(rounds: Rounds, sweep: Sweep, runs: Mapping[str, RunsBySeed]) -> dict[Key, int | None]:
    """Return how many seeds would decide each inconclusive comparison of variants that have no next look.

    The numbers are for 80 % power, if the effect is as measured, at a single look, with a correction over all
    comparisons without a claim. None means that no number of seeds would be enough with these clips.
    """
    latest, ahead = rounds.latest(), rounds.next_looks(sweep)
    still = [key for key, (finding, _) in latest.items() if finding.inconclusive and key.label not in ahead]
    unclaimed = sum(
        key not in latest or latest[key][0].verdict is Verdict.INCONCLUSIVE for key in rounds.family(sweep)
    )
    found = {}
    for key, pair in paired(with_existing_branches(sweep, runs), runs, MODES).items():
        if key in still:
            mean = abs(float(pair.matrix.mean()))
            effect = max(mean, sweep.smallest[key.metric] - mean)
            found[key] = seeds_needed(pair.matrix, effect, unclaimed, pair.groups)
    return found


@dataclass(frozen=True)
class VariantProgress:
    """A variant's progress through the rounds.

    Attributes:
        label: the variant's label.
        decided, inconclusive: how many of its comparisons are decided and inconclusive.
        seeds: the number of seeds spent on it, or needed for its next look.
        next: the number of seeds of its next look; None if it has none.
    """

    label: str
    decided: int
    inconclusive: int
    seeds: int
    next: int | None


def standings(rounds: Rounds, sweep: Sweep) -> list[VariantProgress]:
    """Return each variant's progress through the rounds."""
    ahead = rounds.next_looks(sweep)
    found: dict[str, list[Verdict]] = {}
    for finding, _ in rounds.latest().values():
        found.setdefault(finding.label, []).append(finding.verdict)
    standing = []
    for label, seeds in rounds.counts(sweep).items():
        verdicts = found.get(label, [])
        still = verdicts.count(Verdict.INCONCLUSIVE)
        following = rounds.looks[ahead[label]] if label in ahead else None
        standing.append(VariantProgress(label, len(verdicts) - still, still, seeds, following))
    return standing


def as_json(rounds: Rounds) -> dict[str, Any]:
    """Return the rounds in types for JSON."""
    return asdict(rounds)


def of_json(content: Mapping[str, Any]) -> Rounds:
    """Return the rounds in a file's content. Raises KeyError, TypeError or ValueError if there are none."""
    taken = [
        Look(
            **{
                **look,
                "found": tuple(Finding(**{**f, "verdict": Verdict(f["verdict"])}) for f in look["found"]),
            }
        )
        for look in content["taken"]
    ]
    words = {name: tuple(content[name]) for name in ("seeds", "looks", "levels")}
    return Rounds(content["subject"], **words, taken=tuple(taken))


def _compared(sweep: Sweep) -> Iterator[tuple[Variant, Variant]]:
    """Yield the variants that have a control and metrics to compare, with their controls."""
    for variant in sweep.runnable():
        other = control_variant(sweep, variant)
        if other is not None and set(sweep.metrics) - set(COSTS):
            yield variant, other


def _keys(sweep: Sweep, variant: Variant) -> list[Key]:
    """Return all comparisons that a variant may have."""
    metrics = [metric for metric in sweep.metrics if metric not in COSTS]
    return [Key(variant.label, mode, metric) for mode, metric in itertools.product(MODES, metrics)]


def _ready(rounds: Rounds, sweep: Sweep, runs: Mapping[str, RunsBySeed], label: str, number: int) -> bool:
    """Return whether all runs that a variant's look needs are finished."""
    wanted = set(rounds.seeds[: rounds.looks[number]])
    return all(wanted <= set(runs[one]) for one in pair_of(sweep, label))


def pair_of(sweep: Sweep, label: str) -> tuple[str, str]:
    """Return the labels of a variant and its control."""
    return next((variant.label, other.label) for variant, other in _compared(sweep) if variant.label == label)


def _found(rounds: Rounds, sweep: Sweep, runs: Mapping[str, RunsBySeed], look: Look) -> list[Finding]:
    """Return a look's findings on those comparisons of its variants that are not decided yet."""
    before = {key: finding.verdict for key, (finding, _) in rounds.latest().items()}
    seen = _seen(rounds, sweep, runs, look)
    fresh = {
        key: e for key, e in seen.items() if before.get(key, Verdict.INCONCLUSIVE) is Verdict.INCONCLUSIVE
    }
    elsewhere = [
        before.get(key, Verdict.INCONCLUSIVE)
        for key in rounds.family(sweep)
        if key not in fresh and (key in before or key.label not in look.runs)
    ]
    different, equal = _corrected(list(fresh.values()), elsewhere, look.level)
    variants = {variant.label: variant for variant in sweep.variants}
    found = []
    for (key, effect), p, q in zip(fresh.items(), different, equal, strict=True):
        paper = paper_effect(sweep, variants[key.label], key.metric)
        said = verdict(float(p), float(q), effect.mean, paper, look.level)
        found.append(Finding(*key, said, effect.mean, effect.p, or_none(p), or_none(q)))
    return found


def _seen(rounds: Rounds, sweep: Sweep, runs: Mapping[str, RunsBySeed], look: Look) -> dict[Key, Effect]:
    """Return all comparisons of a look's variants, over exactly the look's seeds."""
    seeds = rounds.seeds[: look.seeds]
    cut = {label: {s: found[s] for s in seeds if s in found} for label, found in runs.items()}
    pairs = paired(with_existing_branches(sweep, cut), cut, MODES, look.runs)
    return tested(pairs, sweep.smallest, sensitivity=False)


def _corrected(
    fresh: Sequence[Effect], elsewhere: Sequence[Verdict], level: float
) -> tuple[np.ndarray, np.ndarray]:
    """Correct p-values of differences and of equivalences (K,), over fresh and all other comparisons.

    Args:
        fresh: the comparisons (K) that the look can decide.
        elsewhere: the verdicts of the other comparisons: decided before, or inconclusive because their
            variants are at another look.
        level: the level that the look spends.
    """
    none = [Verdict.INCONCLUSIVE] * len(fresh)
    same = np.array([said is Verdict.EQUIVALENT for said in [*none, *elsewhere]], bool)
    differ = np.array(
        [said not in (Verdict.EQUIVALENT, Verdict.INCONCLUSIVE) for said in [*none, *elsewhere]], bool
    )
    away = np.arange(len(same)) >= len(fresh)
    p, q = (
        np.array([or_nan(getattr(effect, name)) for effect in fresh] + [math.nan] * len(elsewhere))
        for name in ("p", "equal")
    )
    equal = sequential(q, same, away & ~same)
    different = sequential(p, differ, (away | (equal <= level)) & ~differ)
    return different[: len(fresh)], equal[: len(fresh)]


def _as_found(effect: Effect, finding: Finding | None, look: Look | None) -> Effect:
    """Return the effect with the finding of its last look; inconclusive if there was no look."""
    if finding is None or look is None:
        return replace(effect, holm=None, equal=None, verdict=Verdict.INCONCLUSIVE)
    decided = None if finding.verdict is Verdict.INCONCLUSIVE else look.seeds
    return replace(
        effect,
        holm=finding.holm,
        equal=finding.equal,
        verdict=finding.verdict,
        level=look.level,
        decided=decided,
    )
