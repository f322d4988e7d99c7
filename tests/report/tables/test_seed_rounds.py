"""Rounds of seeds: who gets more, what is decided at which look, and how often that is wrong."""

import functools
from collections.abc import Callable, Mapping

import numpy as np
import pytest

from memmlp.report.tables.build_table import make_table
from memmlp.report.tables.effects import RunsBySeed
from memmlp.report.tables.measured_run import MeasuredRun, Origin
from memmlp.report.tables.seed_rounds import Rounds, do_next_analysis, start_rounds
from memmlp.report.tables.statistics import Verdict
from memmlp.sweep.definition import Sweep
from memmlp.sweep.sweep_file import parse_sweep

ORIGIN = Origin("c", False, "d", "cpu")
CLIPS = [f"clip {number}" for number in range(10)]
VARIANTS = {"full": [], "worse": ["a=1"], "same": ["a=2"], "unsure": ["a=3"], "paper": {"overrides": None}}
SWEEP = parse_sweep(
    "mine", {"seeds": [4, 2], "control": "full", "metrics": ["MPJPE", "FLOPs"], "variants": VARIANTS}
)
TRUTH = {"full": 0.0, "worse": 2.0, "same": 0.0, "unsure": 0.09}  # the smallest effect of interest is 0.1

Draw = Callable[[str, int, str], np.ndarray]  # (label, seed, "mode metric") -> the error on each clip


def run(label: str, seed: int, draw: Draw, metrics: tuple[str, ...], groups: dict[str, str]) -> MeasuredRun:
    modes = ("stream", "window")
    numbers = {mode: {m: draw(label, seed, f"{mode} {m}") for m in metrics} for mode in modes}
    several = len(next(iter(numbers["stream"].values())))
    clips = {
        clip: {mode: {"rotation": {m: float(numbers[mode][m][i]) for m in metrics}} for mode in modes}
        for i, clip in enumerate(CLIPS[:several])
    }
    means = {mode: {"rotation": {m: float(numbers[mode][m].mean()) for m in metrics}} for mode in modes}
    return MeasuredRun(f"{label} {seed}", means, clips, groups, {}, ORIGIN)


def planted(label: str, seed: int, metric: str) -> np.ndarray:
    """Return the variant's true error with noise by seed and clip; the variant "unsure" has more noise."""
    noise = np.random.default_rng([seed, *label.encode(), *metric.encode()]).normal(size=len(CLIPS))
    return 5 + TRUTH[label] + (0.4 if label == "unsure" else 0.005) * noise


class World:
    """Makes the runs that rounds want, and remembers which it made."""

    def __init__(self, sweep: Sweep = SWEEP, draw: Draw = planted, groups: Mapping[str, str] | None = None):
        self.sweep, self.draw, self.groups = sweep, draw, groups or {}
        self.failing: set[tuple[str, int]] = set()
        self.runs: dict[str, dict[int, MeasuredRun]] = {one.label: {} for one in sweep.list_runnable()}

    def spend(self, rounds: Rounds) -> Mapping[str, RunsBySeed]:
        spent = rounds.restrict_sweep(self.sweep)
        for variant in spent.list_runnable():
            for seed in set(spent.get_seeds(variant)) - self.runs[variant.label].keys():
                if (variant.label, seed) not in self.failing:
                    metrics = tuple(metric for metric in self.sweep.metrics if metric != "FLOPs")
                    self.runs[variant.label][seed] = run(variant.label, seed, self.draw, metrics, self.groups)
        return self.runs

    def to_the_end(self, rounds: Rounds) -> Rounds:
        while (after := self.look(rounds)) != rounds:
            rounds = after
        return rounds

    def look(self, rounds: Rounds) -> Rounds:
        names = {label: f"{label} {n}" for label, n in rounds.find_next_analyses(self.sweep).items()}
        return do_next_analysis(rounds, self.sweep, self.spend(rounds), names)


def verdicts(rounds: Rounds, mode: str = "stream") -> dict[str, tuple[str, int]]:
    return {
        key.label: (str(finding.verdict), look.seeds)
        for key, (finding, look) in rounds.find_latest().items()
        if key.mode == mode
    }


def test_the_schedule_is_fixed_at_the_start():
    rounds = start_rounds(SWEEP, 6)
    assert rounds.seeds == (4, 2, 5, 6, 7, 8)  # the sweep's own, then those that follow
    assert rounds.schedule == (3, 5, 6)
    assert sum(rounds.levels) == pytest.approx(0.05)
    assert rounds.find_next_analyses(SWEEP) == {"worse": 0, "same": 0, "unsure": 0}
    spent = rounds.restrict_sweep(SWEEP)
    assert [spent.get_seeds(variant) for variant in spent.list_runnable()] == [(4, 2, 5)] * len(TRUTH)
    assert start_rounds(SWEEP, 1 + 2).schedule == (3,)


def test_open_variants_and_their_control_alone_go_on():
    world = World()
    rounds = world.look(start_rounds(SWEEP))
    found = {"worse": ("higher", 3), "same": ("equivalent", 3), "unsure": ("inconclusive", 3)}
    assert (verdicts(rounds), rounds.find_next_analyses(SWEEP)) == (found, {"unsure": 1})
    assert rounds.count_seeds(SWEEP) == {"full": 5, "worse": 3, "same": 3, "unsure": 5}
    rounds = world.to_the_end(rounds)
    assert [look.seeds for look in rounds.analyses] == [3, 5, 8, 13]
    assert verdicts(rounds)["unsure"] == ("inconclusive", 13)
    assert {label: len(runs) for label, runs in world.runs.items()} == {
        "full": 13, "worse": 3, "same": 3, "unsure": 13
    }  # fmt: skip
    assert rounds.find_next_analyses(SWEEP) == {}


def test_what_is_decided_stays_though_later_data_would_reverse_it():
    """`other` is the control of an inconclusive variant, and so gets more seeds."""
    variants = {"full": [], "other": ["a=1"], "unsure": {"overrides": ["a=3"], "against": "other"}}
    sweep = parse_sweep("chain", {"seeds": [0], "metrics": ["MPJPE"], "variants": variants})

    def draw(label: str, seed: int, metric: str) -> np.ndarray:
        if label == "other" and seed >= 3:
            return planted("full", seed, metric) - 3
        return planted({"other": "worse"}.get(label, label), seed, metric) + 2 * (label == "unsure")

    world = World(sweep, draw)
    rounds = world.to_the_end(start_rounds(sweep, 5))
    assert rounds.count_seeds(sweep) == {"full": 3, "other": 5, "unsure": 5}
    assert verdicts(rounds)["other"] == ("higher", 3)
    assert [f.label for f in rounds.analyses[1].findings] == ["unsure"] * 2  # it was not looked at again
    table = make_table(rounds.restrict_sweep(sweep), world.runs, rounds=rounds)
    cell = next(row for row in table.rows if row.label == "other").cells["stream"]["MPJPE"]
    assert (cell.effect.verdict, cell.effect.decided) == (Verdict.HIGHER, 3)
    assert cell.effect.is_significant


def test_a_look_uses_its_seeds_alone_whatever_other_runs_there_are():
    few, many = World(), World()
    whole = start_rounds(SWEEP, 13)
    for seed in whole.seeds:
        for label in TRUTH:
            many.runs[label][seed] = run(label, seed, planted, ("MPJPE",), {})
    assert few.to_the_end(whole) == many.to_the_end(whole)


def test_one_group_of_clips_ends_it_at_once_and_a_control_that_failed_before():
    world = World(groups=dict.fromkeys(CLIPS, "one take"))
    rounds = world.to_the_end(start_rounds(SWEEP))
    assert len(rounds.analyses) == 1
    assert {verdict for verdict, _ in verdicts(rounds).values()} == {"inconclusive"}
    assert rounds.find_next_analyses(SWEEP) == {}
    world = World()
    world.failing = {("full", 5)}
    assert world.to_the_end(start_rounds(SWEEP)).analyses == ()


def test_an_variant_whose_runs_failed_is_late_and_others_do_not_wait():
    world = World()
    world.failing = {("worse", 2)}
    rounds = world.to_the_end(start_rounds(SWEEP, 5))
    assert [sorted(look.runs) for look in rounds.analyses] == [["same", "unsure"], ["unsure"]]
    assert rounds.find_next_analyses(SWEEP) == {"worse": 0}
    assert len(rounds.list_comparison_keys(SWEEP)) == 6  # its own count although they were not looked at
    world.failing = set()
    rounds = world.to_the_end(rounds)
    assert verdicts(rounds)["worse"] == ("higher", 3)
    assert [look.level for look in rounds.analyses] == [rounds.levels[0], rounds.levels[1], rounds.levels[0]]


def test_corrections_are_over_all_that_nobody_has_claimed():
    """Of 6 comparisons, 2 differences are claimed at the first look; the next corrects by 4."""
    rounds = World().look(World().look(start_rounds(SWEEP)))
    first, second = rounds.analyses
    plain = {finding.key: finding for finding in first.findings}
    unsure = [f for f in second.findings if f.mode == "stream"]
    assert len(plain) == 6
    assert unsure[0].holm == pytest.approx(min(1, 4 * unsure[0].p))
    equivalent = [f.holm for f in first.findings if f.verdict is Verdict.EQUIVALENT]
    assert set(equivalent) == {1}  # closed to differences


@functools.cache
def normal(number: int, seed: int, label: str, metric: str) -> float:
    """Return the number that a run's error is made of, the same for every truth and noise."""
    return np.random.default_rng([number, seed, *label.encode(), *metric.encode()]).normal()


@pytest.mark.slow
@pytest.mark.parametrize(("truth", "noise"), [(0.0, 5.0), (1.0, 0.5)])
def test_false_claims_keep_to_the_level_over_all_rounds(truth: float, noise: float):
    """Differences vary by seed alone, where p-values are exact, and two clips say as much as more. `truth` is
    the true difference of all variants: 0, or 1, the smallest effect of interest, where a claim of
    equivalence is false."""
    variants = {"full": [], **{f"variant {number}": [f"a={number}"] for number in range(5)}}
    sweep = parse_sweep("null", {"metrics": ["MPJPE"], "smallest": {"MPJPE": 1.0}, "variants": variants})
    false = ("equivalent",) if truth else ("higher", "lower")
    counts = []
    for number in range(80):

        def draw(label: str, seed: int, metric: str, number: int = number) -> np.ndarray:
            difference = noise * normal(number, seed, label, metric) + truth if label != "full" else 0.0
            return np.full(2, difference)

        rounds = World(sweep, draw).to_the_end(start_rounds(sweep))
        counts.append(any(finding.verdict in false for finding, _ in rounds.find_latest().values()))
    assert np.mean(counts) <= 0.1
