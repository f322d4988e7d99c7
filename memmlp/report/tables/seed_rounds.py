"""Rounds of seeds for variants with inconclusive verdicts: interim analyses fixed in advance, and their
findings.

Every variant goes through the same interim analyses, each at a number of seeds that was fixed at the start. A
variant whose comparisons are all decided gets no further ones. An analysis uses the first seeds of a variant
and of its control, whatever other seeds exist, and what it decides is final. It spends its level over all
comparisons of the sweep about which nothing has been claimed, including those of variants that are at another
analysis. So the levels add up to 5 % for either family of claims, even if a variant is late because its runs
failed (docs/statistics.md).
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from memmlp.common.errors import InputError
from memmlp.common.files import digest
from memmlp.report.tables.effects import (
    RunsBySeed,
    estimate_effects,
    find_paper_effect,
    list_comparisons,
    or_nan,
    or_none,
    pair_differences,
    use_existing_branches,
)
from memmlp.report.tables.statistics import (
    Verdict,
    correct_sequentially,
    decide,
    divide_level,
    make_schedule,
)
from memmlp.report.tables.table import Effect, Key
from memmlp.sweep.definition import COSTS, MODES, Sweep, Variant
from memmlp.sweep.plan import Plan

MOST = 13  # the largest number of seeds of a variant by default
ROUNDS_FILE = "rounds.json"


@dataclass(frozen=True)
class Finding:
    """The finding of an interim analysis on one comparison.

    Attributes:
        label, mode, metric: which comparison it is.
        verdict: the verdict, final unless it is inconclusive.
        mean: the mean difference.
        p: its p-value; None with one group of clips, or where a network diverged on a clip: no number of
            seeds can decide the comparison.
        holm: the corrected p-value of the difference, to be compared with the analysis' level.
        equal: the corrected p-value of equivalence, to be compared with the analysis' level.
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
    def undecided(self) -> bool:
        """Whether more seeds can decide the comparison: it is inconclusive, and was tested.

        A comparison without a p-value, such as that of a variant with too few runs, waits for other reasons.
        """
        return self.verdict is Verdict.INCONCLUSIVE and self.p is not None


@dataclass(frozen=True)
class Analysis:
    """An interim analysis that was done.

    Attributes:
        seeds: how many seeds of each variant were analysed.
        level: the level that it spent.
        runs: by the label of each analysed variant, a digest of the variant's runs and its control's.
        findings: the findings on the comparisons that were inconclusive before.
    """

    seeds: int
    level: float
    runs: Mapping[str, str]
    findings: tuple[Finding, ...]


@dataclass(frozen=True)
class Rounds:
    """The rounds of a sweep.

    Attributes:
        subject: what the verdicts depend on (`describe_subject`).
        seeds: all seeds that may be spent, in order.
        schedule: the number of seeds at each interim analysis.
        levels: the level that each of them spends.
        analyses: the interim analyses that were done.
    """

    subject: Mapping[str, Any]
    seeds: tuple[int, ...]
    schedule: tuple[int, ...]
    levels: tuple[float, ...]
    analyses: tuple[Analysis, ...] = ()

    def position(self, label: str) -> int:
        """Return how many analyses a variant has been through."""
        return sum(label in one.runs for one in self.analyses)

    def latest(self) -> dict[Key, tuple[Finding, Analysis]]:
        """Return the last finding on each comparison, with its analysis; decided ones were decided there."""
        return {finding.key: (finding, one) for one in self.analyses for finding in one.findings}

    def upcoming(self, sweep: Sweep) -> dict[str, int]:
        """Return, by label, the number (from 0) of the next analysis of each variant that has one.

        A variant has a next one while some are scheduled, and it has an inconclusive comparison or had no
        analysis yet.
        """
        going = {finding.label for finding, _ in self.latest().values() if finding.undecided}
        found = {variant.label: self.position(variant.label) for variant, _ in _compared(sweep)}
        return {
            label: number
            for label, number in found.items()
            if number < len(self.schedule) and (number == 0 or label in going)
        }

    def seed_counts(self, sweep: Sweep) -> dict[str, int]:
        """Return how many seeds each variant is to be trained with.

        This is the number of its latest or next analysis, or of such an analysis of a variant that is
        compared with it, whichever is larger.
        """
        upcoming = self.upcoming(sweep)
        found = {variant.label: self.schedule[0] for variant in sweep.runnable()}
        for variant, other in _compared(sweep):
            number = upcoming.get(variant.label, self.position(variant.label) - 1)
            for label in (variant.label, other.label):
                found[label] = max(found[label], self.schedule[number])
        return found

    def spent(self, sweep: Sweep) -> Sweep:
        """Return the sweep with seeds for each variant: those spent so far and those of its next analysis."""
        counts = self.seed_counts(sweep)
        variants = tuple(
            replace(one, seeds=self.seeds[: counts[one.label]]) if one.label in counts else one
            for one in sweep.variants
        )
        return replace(sweep, variants=variants, seeds=self.seeds[: max(counts.values())])

    def comparisons(self, sweep: Sweep) -> list[Key]:
        """Return all comparisons: those with findings, and all possible ones of variants not analysed yet."""
        new = [variant for variant, _ in _compared(sweep) if not self.position(variant.label)]
        keys = (key for variant in new for key in _possible_keys(sweep, variant))
        return list(dict.fromkeys([*self.latest(), *keys]))

    def apply_verdicts(self, effects: Mapping[Key, Effect]) -> dict[Key, Effect]:
        """Return the effects with the analyses' verdicts in place of those from a fixed number of seeds."""
        latest, found = self.latest(), dict(effects)
        for key, effect in effects.items():
            if not effect.verdict:
                continue
            if key not in latest:
                found[key] = replace(effect, holm=None, equal=None, verdict=Verdict.INCONCLUSIVE)
                continue
            finding, analysis = latest[key]
            found[key] = replace(
                effect,
                holm=finding.holm,
                equal=finding.equal,
                verdict=finding.verdict,
                level=analysis.level,
                decided=None if finding.verdict is Verdict.INCONCLUSIVE else analysis.seeds,
            )
        return found

    def difference(self, wanted: Rounds) -> str | None:
        """Name in a word what differs from the other rounds of the sweep; None if nothing does."""
        if self.seeds != wanted.seeds:
            return "seeds"
        if (self.schedule, self.levels) != (wanted.schedule, wanted.levels):
            return "interim analyses"
        return next((key for key, value in wanted.subject.items() if self.subject.get(key) != value), None)

    @classmethod
    def of_json(cls, content: Mapping[str, Any]) -> Rounds:
        """Return the rounds that `asdict` made. Raises KeyError, TypeError or ValueError if wrong."""
        analyses = []
        for one in content["analyses"]:
            findings = tuple(Finding(**{**f, "verdict": Verdict(f["verdict"])}) for f in one["findings"])
            analyses.append(Analysis(**{**one, "findings": findings}))
        fields = {name: tuple(content[name]) for name in ("seeds", "schedule", "levels")}
        return cls(content["subject"], **fields, analyses=tuple(analyses))

    @classmethod
    def read(cls, path: Path) -> Rounds | None:
        """Read the rounds in a file; None if there is no file. Raises InputError if it is damaged."""
        try:
            return cls.of_json(json.loads(path.read_bytes()))
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path}: not a record of rounds ({error}); remove it to restart them") from None


def describe_subject(sweep: Sweep) -> dict[str, Any]:
    """Return what the verdicts depend on, in types for JSON; it must not change between two analyses."""
    return {
        "variants": {
            variant.label: {
                "branch": variant.branch,
                "against": sweep.control_of(variant),
                "paper": {metric: find_paper_effect(sweep, variant, metric) for metric in sweep.metrics},
            }
            for variant in sweep.runnable()
        },
        "metrics": list(sweep.metrics),
        "smallest": {name: sweep.smallest[name] for name in sweep.metrics if name in sweep.smallest},
    }


def start_rounds(sweep: Sweep, most: int = MOST) -> Rounds:
    """Return new rounds of a sweep with at most `most` seeds.

    The sweep's own seeds come first, then the whole numbers that follow the largest of them.
    """
    following = itertools.count(max(sweep.seeds) + 1)
    seeds = tuple(itertools.islice(itertools.chain(sweep.seeds, following), most))
    schedule = make_schedule(most)
    return Rounds(describe_subject(sweep), seeds, schedule, divide_level(len(schedule)))


def advance(
    rounds: Rounds, sweep: Sweep, runs: Mapping[str, RunsBySeed], digests: Mapping[str, str]
) -> Rounds:
    """Return the rounds after the next analysis that can be done; the same rounds if none can be.

    A variant can be analysed when it and its control have all seeds of its next analysis. If runs failed,
    variants may be at different analyses; those at an earlier one come first.

    Args:
        rounds: the rounds so far.
        sweep: the sweep with which the rounds began.
        runs: the finished runs by label and seed.
        digests: by label, a digest of the runs of a variant and its control up to its next analysis.
    """
    ready: dict[int, list[str]] = {}
    for label, number in rounds.upcoming(sweep).items():
        wanted = set(rounds.seeds[: rounds.schedule[number]])
        if all(wanted <= set(runs[one]) for one in _pair(sweep, label)):
            ready.setdefault(number, []).append(label)
    if not ready:
        return rounds
    number = min(ready)
    named = {label: digests[label] for label in ready[number]}
    analysis = Analysis(rounds.schedule[number], rounds.levels[number], named, ())
    analysis = replace(analysis, findings=tuple(_findings(rounds, sweep, runs, analysis)))
    return replace(rounds, analyses=(*rounds.analyses, analysis))


@dataclass(frozen=True)
class VariantProgress:
    """A variant's progress through the rounds.

    Attributes:
        label: the variant's label.
        decided, inconclusive: how many of its comparisons are decided and inconclusive.
        seeds: the number of seeds spent on it, or needed for its next analysis.
        next: the number of seeds of its next analysis; None after the last one.
    """

    label: str
    decided: int
    inconclusive: int
    seeds: int
    next: int | None


def list_progress(rounds: Rounds, sweep: Sweep) -> list[VariantProgress]:
    """Return each variant's progress through the rounds."""
    upcoming = rounds.upcoming(sweep)
    verdicts: dict[str, list[Verdict]] = {}
    for finding, _ in rounds.latest().values():
        verdicts.setdefault(finding.label, []).append(finding.verdict)
    found = []
    for label, seeds in rounds.seed_counts(sweep).items():
        own = verdicts.get(label, [])
        still = own.count(Verdict.INCONCLUSIVE)
        following = rounds.schedule[upcoming[label]] if label in upcoming else None
        found.append(VariantProgress(label, len(own) - still, still, seeds, following))
    return found


def digest_runs(rounds: Rounds, sweep: Sweep, plan: Plan, label: str, seeds: int) -> str:
    """Return a digest of the identities of a variant's and its control's runs with the first `seeds` seeds.

    The identities include the evaluations that the sweep shows.
    """
    keys = {(entry.label, entry.seed): entry.key for entry in plan.entries}
    cells = [keys.get((one, seed)) for one in _pair(sweep, label) for seed in rounds.seeds[:seeds]]
    return digest(cells)[:16]


def check_same_runs(rounds: Rounds, sweep: Sweep, plan: Plan, path: Path) -> None:
    """Check that past analyses compared the same runs that the sweep's variants have now.

    Raises:
        InputError: if an analysis compared other runs, after a change of data, configs or versions.
    """
    for one in rounds.analyses:
        for label, known in one.runs.items():
            if known != digest_runs(rounds, sweep, plan, label, one.seeds):
                raise InputError(
                    f"{path}: its interim analyses were of other runs of '{label}': data, configs or "
                    "versions changed since; remove it to restart them"
                )


def _compared(sweep: Sweep) -> Iterator[tuple[Variant, Variant]]:
    return list_comparisons(sweep) if set(sweep.metrics) - set(COSTS) else iter(())


def _possible_keys(sweep: Sweep, variant: Variant) -> list[Key]:
    metrics = [metric for metric in sweep.metrics if metric not in COSTS]
    return [Key(variant.label, mode, metric) for mode, metric in itertools.product(MODES, metrics)]


def _pair(sweep: Sweep, label: str) -> tuple[str, str]:
    return next((one.label, other.label) for one, other in _compared(sweep) if one.label == label)


def _findings(
    rounds: Rounds, sweep: Sweep, runs: Mapping[str, RunsBySeed], analysis: Analysis
) -> list[Finding]:
    seeds = rounds.seeds[: analysis.seeds]
    cut = {label: {s: found[s] for s in seeds if s in found} for label, found in runs.items()}
    pairs = pair_differences(use_existing_branches(sweep, cut), cut, MODES, analysis.runs)
    before = {key: finding.verdict for key, (finding, _) in rounds.latest().items()}
    fresh = {
        key: effect
        for key, effect in estimate_effects(pairs, sweep.smallest, sensitivity=False).items()
        if before.get(key, Verdict.INCONCLUSIVE) is Verdict.INCONCLUSIVE
    }
    elsewhere = [
        before.get(key, Verdict.INCONCLUSIVE)
        for key in rounds.comparisons(sweep)
        if key not in fresh and (key in before or key.label not in analysis.runs)
    ]
    different, equal = _corrected(list(fresh.values()), elsewhere, analysis.level)
    variants = {variant.label: variant for variant in sweep.variants}
    found = []
    for (key, effect), p, q in zip(fresh.items(), different, equal, strict=True):
        paper = find_paper_effect(sweep, variants[key.label], key.metric)
        claim = decide(float(p), float(q), effect.mean, paper, analysis.level)
        found.append(Finding(*key, claim, effect.mean, effect.p, or_none(p), or_none(q)))
    return found


def _corrected(
    fresh: Sequence[Effect], elsewhere: Sequence[Verdict], level: float
) -> tuple[np.ndarray, np.ndarray]:
    """Correct p-values of differences and of equivalences (K,), over fresh and all other comparisons.

    Args:
        fresh: the comparisons (K) that the analysis can decide.
        elsewhere: the verdicts of the other comparisons: decided before, or inconclusive because their
            variants are at another analysis.
        level: the level that the analysis spends.
    """
    claims = [*[Verdict.INCONCLUSIVE] * len(fresh), *elsewhere]
    same = np.array([claim is Verdict.EQUIVALENT for claim in claims], bool)
    differ = np.array([claim not in (Verdict.EQUIVALENT, Verdict.INCONCLUSIVE) for claim in claims], bool)
    away = np.arange(len(same)) >= len(fresh)
    p, q = (
        np.array([or_nan(getattr(effect, name)) for effect in fresh] + [math.nan] * len(elsewhere))
        for name in ("p", "equal")
    )
    equal = correct_sequentially(q, same, away & ~same)
    different = correct_sequentially(p, differ, (away | (equal <= level)) & ~differ)
    return different[: len(fresh)], equal[: len(fresh)]
