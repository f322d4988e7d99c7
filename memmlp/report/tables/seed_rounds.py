"""Seed rounds: variants with inconclusive verdicts get more seeds, in interim analyses fixed in advance.

The numbers of seeds at the interim analyses are the same for all variants. A variant leaves the rounds when
all its comparisons are decided. An analysis uses only the first seeds of a variant and its control. Its
decisions are final.

An analysis spends its level on all undecided comparisons of the sweep. These include variants that are at
another analysis because runs failed. So the levels add up to 5 % for each family of claims
(docs/statistics.md).
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from memmlp.common.errors import InputError
from memmlp.common.files import digest
from memmlp.report.tables.effects import (
    RunsBySeed,
    collect_p_values,
    convert_nan_to_none,
    estimate_effects,
    find_paper_effect,
    list_comparisons,
    pair_differences,
    use_existing_branches,
)
from memmlp.report.tables.statistics import (
    Verdict,
    correct_sequentially,
    decide_verdict,
    divide_level,
    make_schedule,
)
from memmlp.report.tables.table import Effect, Key
from memmlp.sweep.definition import COSTS, MODES, Sweep, Variant
from memmlp.sweep.plan import Plan

MAX_SEEDS = 13  # default maximum number of seeds of a variant
ROUNDS_FILE = "rounds.json"


@dataclass(frozen=True)
class InterimFinding:
    """The result of an interim analysis for one comparison.

    Attributes:
        label, mode, metric: the key of the comparison.
        verdict: the verdict; final unless inconclusive.
        mean: the mean difference.
        p: the p-value. None with a single clip group, or if a network diverged on a clip; then more seeds
            cannot decide the comparison.
        holm: the corrected p-value of the difference, for comparison with the analysis' level.
        equal: the corrected p-value of equivalence, for comparison with the analysis' level.
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
    def is_undecided(self) -> bool:
        """Whether more seeds can decide the comparison: it is inconclusive and has a p-value."""
        return self.verdict is Verdict.INCONCLUSIVE and self.p is not None


@dataclass(frozen=True)
class Analysis:
    """A finished interim analysis.

    Attributes:
        seeds: the number of seeds of each analysed variant.
        level: the level that it spent.
        runs: a digest of the runs of variant and control, by label of each analysed variant.
        findings: the results for comparisons that were inconclusive before.
    """

    seeds: int
    level: float
    runs: Mapping[str, str]
    findings: tuple[InterimFinding, ...]


@dataclass(frozen=True)
class Rounds:
    """The seed rounds of a sweep.

    Attributes:
        subject: the facts that determine the verdicts (`describe_subject`).
        seeds: all available seeds, in order.
        schedule: the number of seeds at each interim analysis.
        levels: the level of each interim analysis.
        analyses: the finished interim analyses.
    """

    subject: Mapping[str, Any]
    seeds: tuple[int, ...]
    schedule: tuple[int, ...]
    levels: tuple[float, ...]
    analyses: tuple[Analysis, ...] = ()

    def count_analyses(self, label: str) -> int:
        """Count the finished analyses of a variant."""
        return sum(label in one.runs for one in self.analyses)

    def find_latest(self) -> dict[Key, tuple[InterimFinding, Analysis]]:
        """Return the last finding for each comparison, with its analysis."""
        return {finding.key: (finding, one) for one in self.analyses for finding in one.findings}

    def find_next_analyses(self, sweep: Sweep) -> dict[str, int]:
        """Return the index of the next analysis, by label, for variants with a next analysis.

        A variant has a next analysis until the end of the schedule, if it has an undecided comparison or no
        finished analysis.
        """
        going = {finding.label for finding, _ in self.find_latest().values() if finding.is_undecided}
        found = {variant.label: self.count_analyses(variant.label) for variant, _ in _list_comparisons(sweep)}
        return {
            label: number
            for label, number in found.items()
            if number < len(self.schedule) and (number == 0 or label in going)
        }

    def count_seeds(self, sweep: Sweep) -> dict[str, int]:
        """Return the number of seeds to train, by label.

        A variant needs the seeds of its next analysis, or of its last analysis at the end. A control needs
        the seeds of all variants that are compared with it.
        """
        upcoming = self.find_next_analyses(sweep)
        found = {variant.label: self.schedule[0] for variant in sweep.list_runnable()}
        for variant, other in _list_comparisons(sweep):
            number = upcoming.get(variant.label, self.count_analyses(variant.label) - 1)
            for label in (variant.label, other.label):
                found[label] = max(found[label], self.schedule[number])
        return found

    def restrict_sweep(self, sweep: Sweep) -> Sweep:
        """Return the sweep with the seeds to train for each variant (`count_seeds`)."""
        counts = self.count_seeds(sweep)
        variants = tuple(
            replace(one, seeds=self.seeds[: counts[one.label]]) if one.label in counts else one
            for one in sweep.variants
        )
        return replace(sweep, variants=variants, seeds=self.seeds[: max(counts.values())])

    def list_comparison_keys(self, sweep: Sweep) -> list[Key]:
        """Return the keys of all findings, and all possible keys of variants without a finished analysis."""
        new = [variant for variant, _ in _list_comparisons(sweep) if not self.count_analyses(variant.label)]
        keys = (key for variant in new for key in _list_possible_keys(sweep, variant))
        return list(dict.fromkeys([*self.find_latest(), *keys]))

    def apply_verdicts(self, effects: Mapping[Key, Effect]) -> dict[Key, Effect]:
        """Return the effects with the verdicts of the interim analyses."""
        latest, found = self.find_latest(), dict(effects)
        for key, effect in effects.items():
            if effect.verdict and key not in latest:
                found[key] = replace(effect, holm=None, equal=None, verdict=Verdict.INCONCLUSIVE)
            elif effect.verdict:
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

    def find_difference(self, other: Rounds) -> str | None:
        """Return the name of the first fact that differs from other rounds; None if all facts are equal."""
        if self.seeds != other.seeds:
            return "seeds"
        if (self.schedule, self.levels) != (other.schedule, other.levels):
            return "interim analyses"
        return next((key for key, value in other.subject.items() if self.subject.get(key) != value), None)

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Rounds:
        """Parse the output of `asdict`. Raises KeyError, TypeError or ValueError for invalid content."""
        analyses = []
        for one in content["analyses"]:
            findings = tuple(
                InterimFinding(**{**f, "verdict": Verdict(f["verdict"])}) for f in one["findings"]
            )
            analyses.append(Analysis(**{**one, "findings": findings}))
        fields = {name: tuple(content[name]) for name in ("seeds", "schedule", "levels")}
        return cls(content["subject"], **fields, analyses=tuple(analyses))

    @classmethod
    def read(cls, path: Path) -> Rounds | None:
        """Read rounds from a file; None if there is no file. Raises InputError for a damaged file."""
        try:
            return cls.from_json(json.loads(path.read_bytes()))
        except FileNotFoundError:
            return None
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path}: damaged ({error}); remove the file to restart the rounds") from None


def describe_subject(sweep: Sweep) -> dict[str, Any]:
    """Return the facts that determine the verdicts, as JSON. They must not change between two analyses."""
    return {
        "variants": {
            variant.label: {
                "branch": variant.branch,
                "against": sweep.find_control(variant),
                "paper": {metric: find_paper_effect(sweep, variant, metric) for metric in sweep.metrics},
            }
            for variant in sweep.list_runnable()
        },
        "metrics": list(sweep.metrics),
        "smallest": {name: sweep.smallest[name] for name in sweep.metrics if name in sweep.smallest},
    }


def start_rounds(sweep: Sweep, max_seeds: int = MAX_SEEDS) -> Rounds:
    """Return new rounds of a sweep: its seeds come first, then the integers after the largest seed."""
    more_seeds = itertools.count(max(sweep.seeds) + 1)
    seeds = tuple(itertools.islice(itertools.chain(sweep.seeds, more_seeds), max_seeds))
    schedule = make_schedule(max_seeds)
    return Rounds(describe_subject(sweep), seeds, schedule, divide_level(len(schedule)))


def do_next_analysis(
    rounds: Rounds, sweep: Sweep, runs: Mapping[str, RunsBySeed], digests: Mapping[str, str]
) -> Rounds:
    """Do the next analysis, and return the new rounds; return `rounds` unchanged if no variant is ready.

    A variant is ready when it and its control have all seeds of its next analysis. If runs failed, variants
    may be at different analyses. Then the earliest analysis comes first.

    Args:
        rounds: the rounds so far.
        sweep: the sweep with which the rounds began.
        runs: the finished runs by label and seed.
        digests: by label, a digest of all runs of variant and control for the variant's next analysis.
    """
    ready: dict[int, list[str]] = {}
    for label, number in rounds.find_next_analyses(sweep).items():
        seeds = set(rounds.seeds[: rounds.schedule[number]])
        if all(seeds <= set(runs[one]) for one in _find_pair(sweep, label)):
            ready.setdefault(number, []).append(label)
    if not ready:
        return rounds
    number = min(ready)
    analysed = {label: digests[label] for label in ready[number]}
    analysis = Analysis(rounds.schedule[number], rounds.levels[number], analysed, ())
    analysis = replace(analysis, findings=tuple(_make_findings(rounds, sweep, runs, analysis)))
    return replace(rounds, analyses=(*rounds.analyses, analysis))


@dataclass(frozen=True)
class VariantProgress:
    """A variant's progress through the rounds.

    Attributes:
        label: the variant's label.
        decided, inconclusive: the numbers of decided and of inconclusive comparisons.
        seeds: the number of seeds to train (`Rounds.count_seeds`).
        next: the number of seeds at the next analysis; None after the last analysis.
    """

    label: str
    decided: int
    inconclusive: int
    seeds: int
    next: int | None


def list_progress(rounds: Rounds, sweep: Sweep) -> list[VariantProgress]:
    """Return each variant's progress through the rounds."""
    upcoming = rounds.find_next_analyses(sweep)
    verdicts: dict[str, list[Verdict]] = {}
    for finding, _ in rounds.find_latest().values():
        verdicts.setdefault(finding.label, []).append(finding.verdict)
    found = []
    for label, seeds in rounds.count_seeds(sweep).items():
        own = verdicts.get(label, [])
        still = own.count(Verdict.INCONCLUSIVE)
        next_seeds = rounds.schedule[upcoming[label]] if label in upcoming else None
        found.append(VariantProgress(label, len(own) - still, still, seeds, next_seeds))
    return found


def digest_runs(rounds: Rounds, sweep: Sweep, plan: Plan, label: str, seeds: int) -> str:
    """Return a digest of the ids of runs and evaluations of a variant, given its label, and its control, for
    the first `seeds` of the rounds."""
    keys = {(entry.label, entry.seed): entry.key for entry in plan.entries}
    cells = [keys.get((one, seed)) for one in _find_pair(sweep, label) for seed in rounds.seeds[:seeds]]
    return digest(cells)[:16]


def check_same_runs(rounds: Rounds, sweep: Sweep, plan: Plan, path: Path) -> None:
    """Check that finished analyses used the current runs of the sweep.

    Raises:
        InputError: if an analysis used other runs, because data, configs or versions have changed since.
    """
    for one in rounds.analyses:
        for label, known in one.runs.items():
            if known != digest_runs(rounds, sweep, plan, label, one.seeds):
                raise InputError(
                    f"{path}: data, configs or versions of '{label}' changed since its interim analyses; "
                    "remove the file to restart the rounds"
                )


def _list_comparisons(sweep: Sweep) -> Iterator[tuple[Variant, Variant]]:
    return list_comparisons(sweep) if set(sweep.metrics) - set(COSTS) else iter(())


def _list_possible_keys(sweep: Sweep, variant: Variant) -> list[Key]:
    metrics = [metric for metric in sweep.metrics if metric not in COSTS]
    return [Key(variant.label, mode, metric) for mode, metric in itertools.product(MODES, metrics)]


def _find_pair(sweep: Sweep, label: str) -> tuple[str, str]:
    return next((one.label, other.label) for one, other in _list_comparisons(sweep) if one.label == label)


def _make_findings(
    rounds: Rounds, sweep: Sweep, runs: Mapping[str, RunsBySeed], analysis: Analysis
) -> list[InterimFinding]:
    seeds = rounds.seeds[: analysis.seeds]
    cut = {label: {s: by_seed[s] for s in seeds if s in by_seed} for label, by_seed in runs.items()}
    pairs = pair_differences(use_existing_branches(sweep, cut), cut, MODES, analysis.runs)
    earlier_verdicts = {key: finding.verdict for key, (finding, _) in rounds.find_latest().items()}
    undecided_effects = {
        key: effect
        for key, effect in estimate_effects(pairs, sweep.smallest, sensitivity=False).items()
        if earlier_verdicts.get(key, Verdict.INCONCLUSIVE) is Verdict.INCONCLUSIVE
    }
    other_verdicts = [
        earlier_verdicts.get(key, Verdict.INCONCLUSIVE)
        for key in rounds.list_comparison_keys(sweep)
        if key not in undecided_effects and (key in earlier_verdicts or key.label not in analysis.runs)
    ]
    different, equal = _correct_p_values(list(undecided_effects.values()), other_verdicts, analysis.level)
    variants = {variant.label: variant for variant in sweep.variants}
    findings = []
    for (key, effect), p, q in zip(undecided_effects.items(), different, equal, strict=True):
        paper = find_paper_effect(sweep, variants[key.label], key.metric)
        claim = decide_verdict(float(p), float(q), effect.mean, paper, analysis.level)
        findings.append(
            InterimFinding(*key, claim, effect.mean, effect.p, convert_nan_to_none(p), convert_nan_to_none(q))
        )
    return findings


def _correct_p_values(
    fresh: Sequence[Effect], elsewhere: Sequence[Verdict], level: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return corrected p-values of differences (K,) and of equivalences (K,).

    The correction includes all comparisons of the sweep.

    Args:
        fresh: the comparisons (K) that the analysis can decide.
        elsewhere: the verdicts on all other comparisons: decided before, or inconclusive because a variant is
            at another analysis.
        level: the level that the analysis spends.
    """
    claims = [*[Verdict.INCONCLUSIVE] * len(fresh), *elsewhere]
    same = np.array([claim is Verdict.EQUIVALENT for claim in claims], bool)
    differ = np.array([claim not in (Verdict.EQUIVALENT, Verdict.INCONCLUSIVE) for claim in claims], bool)
    away = np.arange(len(same)) >= len(fresh)
    known = collect_p_values(fresh, ("p", "equal"))
    p, q = np.pad(known, ((0, 0), (0, len(elsewhere))), constant_values=np.nan)
    equal = correct_sequentially(q, same, away & ~same)
    different = correct_sequentially(p, differ, (away | (equal <= level)) & ~differ)
    return different[: len(fresh)], equal[: len(fresh)]
