"""Rounds of seeds for arms with open verdicts: looks that are fixed in advance, and what they decided.

Every arm goes through the same looks (interim analyses), each at a number of seeds that was fixed at the
start. An arm whose comparisons are all decided gets no further looks. A look uses the first seeds of an arm
and of its control, whatever other seeds exist, and what it decides is final. It spends its level over all
comparisons of the sweep about which nothing has been claimed, including those of arms that are at another
look. So the levels add up to 5 % for either family of claims, even if an arm is late because its runs failed
(docs/statistics.md).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from memmlp.sweep.definition import COSTS, MODES, Arm, Sweep
from memmlp.tables.effects import (
    RunsBySeed,
    control_arm,
    or_nan,
    or_none,
    paired,
    paper_effect,
    tested,
    with_existing_branches,
)
from memmlp.tables.statistics import Verdict, looks, seeds_needed, sequential, spending, verdict
from memmlp.tables.table import Effect, Key

MOST = 13  # the largest number of seeds of an arm by default


@dataclass(frozen=True)
class Finding:
    """The finding of a look on one comparison.

    Attributes:
        label, mode, metric: which comparison it is.
        verdict: the verdict, final unless it is open.
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
    def open(self) -> bool:
        """Whether more seeds can decide the comparison: it is open, and was tested.

        A comparison without a p-value, such as that of an arm with too few runs, waits for other reasons.
        """
        return self.verdict is Verdict.OPEN and self.p is not None


@dataclass(frozen=True)
class Look:
    """A look that was taken.

    Attributes:
        seeds: how many seeds of each arm were looked at.
        level: the level that the look spent.
        runs: by the label of each arm that was looked at, a digest of the arm's runs and its control's.
        found: the findings on the comparisons that were open before.
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
        """Return how many looks an arm has been through."""
        return sum(label in look.runs for look in self.taken)

    def latest(self) -> dict[Key, tuple[Finding, Look]]:
        """Return the last finding on each comparison, with its look; decided ones were decided there."""
        return {finding.key: (finding, look) for look in self.taken for finding in look.found}

    def next_looks(self, sweep: Sweep) -> dict[str, int]:
        """Return, by label, the number (from 0) of the next look of each arm that has one.

        An arm has a next look while looks are left, and it has an open comparison or had no look yet.
        """
        going = {finding.label for finding, _ in self.latest().values() if finding.open}
        found = {arm.label: self.position(arm.label) for arm, _ in _compared(sweep)}
        return {
            label: number
            for label, number in found.items()
            if number < len(self.looks) and (number == 0 or label in going)
        }

    def counts(self, sweep: Sweep) -> dict[str, int]:
        """Return how many seeds each arm is to be trained with.

        This is the number of its latest or next look, or of such a look of an arm that is compared with it,
        whichever is larger.
        """
        ahead = self.next_looks(sweep)
        found = {arm.label: self.looks[0] for arm in sweep.runnable()}
        for arm, other in _compared(sweep):
            number = ahead.get(arm.label, self.position(arm.label) - 1)
            for label in (arm.label, other.label):
                found[label] = max(found[label], self.looks[number])
        return found

    def spent(self, sweep: Sweep) -> Sweep:
        """Return the sweep with seeds for each arm: those spent so far and those of its next look."""
        counts = self.counts(sweep)
        arms = tuple(
            replace(arm, seeds=self.seeds[: counts[arm.label]]) if arm.label in counts else arm
            for arm in sweep.arms
        )
        return replace(sweep, arms=arms, seeds=self.seeds[: max(counts.values())])

    def family(self, sweep: Sweep) -> list[Key]:
        """Return all comparisons: those with findings and, for arms without a look, all possible ones."""
        new = [arm for arm, _ in _compared(sweep) if not self.position(arm.label)]
        return list(dict.fromkeys([*self.latest(), *(key for arm in new for key in _keys(sweep, arm))]))

    def unseen(self, sweep: Sweep) -> list[Key]:
        """Return the comparisons without findings, for arms that were looked at.

        Their runs have no numbers, or are one and the same.
        """
        looked = [arm for arm, _ in _compared(sweep) if self.position(arm.label)]
        return [key for arm in looked for key in _keys(sweep, arm) if key not in self.latest()]

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
        "arms": {
            arm.label: {
                "branch": arm.branch,
                "against": sweep.control_of(arm),
                "paper": {metric: paper_effect(sweep, arm, metric) for metric in sweep.metrics},
            }
            for arm in sweep.runnable()
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

    A look at an arm can be taken when the arm and its control have all seeds of its next look. If runs
    failed, arms may be at different looks; arms at an earlier look then come first.

    Args:
        rounds: the rounds so far.
        sweep: the sweep with which the rounds began.
        runs: the finished runs by label and seed.
        named: by label, a digest of the runs of an arm and its control up to its next look.
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
    """Return how many seeds would decide each open comparison of arms that have no next look.

    The numbers are for 80 % power, if the effect is as measured, at a single look, with a correction over all
    comparisons without a claim. None means that no number of seeds would be enough with these clips.
    """
    latest, ahead = rounds.latest(), rounds.next_looks(sweep)
    still = [key for key, (finding, _) in latest.items() if finding.open and key.label not in ahead]
    unclaimed = sum(
        key not in latest or latest[key][0].verdict is Verdict.OPEN for key in rounds.family(sweep)
    )
    found = {}
    for key, pair in paired(with_existing_branches(sweep, runs), runs, MODES).items():
        if key in still:
            mean = abs(float(pair.matrix.mean()))
            effect = max(mean, sweep.smallest[key.metric] - mean)
            found[key] = seeds_needed(pair.matrix, effect, unclaimed, pair.groups)
    return found


@dataclass(frozen=True)
class ArmProgress:
    """An arm's progress through the rounds.

    Attributes:
        label: the arm's label.
        decided, open: how many of its comparisons are decided and open.
        seeds: the number of seeds spent on it, or needed for its next look.
        next: the number of seeds of its next look; None if it has none.
    """

    label: str
    decided: int
    open: int
    seeds: int
    next: int | None


def standings(rounds: Rounds, sweep: Sweep) -> list[ArmProgress]:
    """Return each arm's progress through the rounds."""
    ahead = rounds.next_looks(sweep)
    found: dict[str, list[Verdict]] = {}
    for finding, _ in rounds.latest().values():
        found.setdefault(finding.label, []).append(finding.verdict)
    standing = []
    for label, seeds in rounds.counts(sweep).items():
        verdicts = found.get(label, [])
        still = verdicts.count(Verdict.OPEN)
        following = rounds.looks[ahead[label]] if label in ahead else None
        standing.append(ArmProgress(label, len(verdicts) - still, still, seeds, following))
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


def _compared(sweep: Sweep) -> Iterator[tuple[Arm, Arm]]:
    """Yield the arms that have a control and metrics to compare, with their controls."""
    for arm in sweep.runnable():
        other = control_arm(sweep, arm)
        if other is not None and set(sweep.metrics) - set(COSTS):
            yield arm, other


def _keys(sweep: Sweep, arm: Arm) -> list[Key]:
    """Return all comparisons that an arm may have."""
    metrics = [metric for metric in sweep.metrics if metric not in COSTS]
    return [Key(arm.label, mode, metric) for mode, metric in itertools.product(MODES, metrics)]


def _ready(rounds: Rounds, sweep: Sweep, runs: Mapping[str, RunsBySeed], label: str, number: int) -> bool:
    """Return whether all runs that an arm's look needs are finished."""
    wanted = set(rounds.seeds[: rounds.looks[number]])
    return all(wanted <= set(runs[one]) for one in pair_of(sweep, label))


def pair_of(sweep: Sweep, label: str) -> tuple[str, str]:
    """Return the labels of an arm and its control."""
    return next((arm.label, other.label) for arm, other in _compared(sweep) if arm.label == label)


def _found(rounds: Rounds, sweep: Sweep, runs: Mapping[str, RunsBySeed], look: Look) -> list[Finding]:
    """Return a look's findings on those comparisons of its arms that are not decided yet."""
    before = {key: finding.verdict for key, (finding, _) in rounds.latest().items()}
    seen = _seen(rounds, sweep, runs, look)
    fresh = {key: e for key, e in seen.items() if before.get(key, Verdict.OPEN) is Verdict.OPEN}
    elsewhere = [
        before.get(key, Verdict.OPEN)
        for key in rounds.family(sweep)
        if key not in fresh and (key in before or key.label not in look.runs)
    ]
    different, equal = _corrected(list(fresh.values()), elsewhere, look.level)
    arms = {arm.label: arm for arm in sweep.arms}
    found = []
    for (key, effect), p, q in zip(fresh.items(), different, equal, strict=True):
        paper = paper_effect(sweep, arms[key.label], key.metric)
        said = verdict(float(p), float(q), effect.mean, paper, look.level)
        found.append(Finding(*key, said, effect.mean, effect.p, or_none(p), or_none(q)))
    return found


def _seen(rounds: Rounds, sweep: Sweep, runs: Mapping[str, RunsBySeed], look: Look) -> dict[Key, Effect]:
    """Return all comparisons of a look's arms, over exactly the look's seeds."""
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
        elsewhere: the verdicts of the other comparisons: decided before, or open because their arms are at
            another look.
        level: the level that the look spends.
    """
    none = [Verdict.OPEN] * len(fresh)
    same = np.array([said is Verdict.EQUIVALENT for said in [*none, *elsewhere]], bool)
    differ = np.array([said not in (Verdict.EQUIVALENT, Verdict.OPEN) for said in [*none, *elsewhere]], bool)
    away = np.arange(len(same)) >= len(fresh)
    p, q = (
        np.array([or_nan(getattr(effect, name)) for effect in fresh] + [math.nan] * len(elsewhere))
        for name in ("p", "equal")
    )
    equal = sequential(q, same, away & ~same)
    different = sequential(p, differ, (away | (equal <= level)) & ~differ)
    return different[: len(fresh)], equal[: len(fresh)]


def _as_found(effect: Effect, finding: Finding | None, look: Look | None) -> Effect:
    """Return the effect with the finding of its last look; open if there was no look."""
    if finding is None or look is None:
        return replace(effect, holm=None, equal=None, verdict=Verdict.OPEN)
    decided = None if finding.verdict is Verdict.OPEN else look.seeds
    return replace(
        effect,
        holm=finding.holm,
        equal=finding.equal,
        verdict=finding.verdict,
        level=look.level,
        decided=decided,
    )
