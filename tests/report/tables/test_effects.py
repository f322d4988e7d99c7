"""Differences from controls, paired by seed and clip, their statistics and verdicts."""

import itertools
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from fake_runs import CLIPS, fake_run, fake_sweep, runs_of, table_of, write_evaluation
from fake_table import EFFECTS, cell, printed

from memmlp.report.tables.build_table import make_table
from memmlp.report.tables.effects import compute_effects, compute_mean_cost
from memmlp.report.tables.measured_run import load_measured_run
from memmlp.report.tables.statistics import (
    Verdict,
    compute_bootstrap_p,
    correct_by_holm,
    estimate_paired_effects,
)
from memmlp.report.tables.table_text import make_legend
from memmlp.sweep.definition import COSTS, Sweep


def test_difference_is_paired_by_seed_and_clip(sweep: Sweep, tmp_path: Path):
    """Effects that both variants share cancel: the interval is far narrower than the variants' own spread."""
    table = table_of(sweep, fake_sweep(tmp_path, sweep, EFFECTS))
    effect = cell(table, "no | memory", "MPJPE").effect
    assert effect is not None
    assert (effect.seeds, effect.clips, effect.groups) == (3, 12, 12)
    assert effect.low < effect.mean < effect.high
    means = [cell(table, label, "MPJPE").mean for label in ("no | memory", "full_model")]
    assert effect.mean == pytest.approx(means[0] - means[1])
    assert effect.mean == pytest.approx(0.2 * means[1], rel=0.1)
    assert effect.is_significant
    assert effect.high - effect.low < 0.5
    run = load_measured_run(next((tmp_path / "runs").iterdir()))
    assert np.ptp(run.get_clip_values(CLIPS, "stream", "rotation", "MPJPE")) > 1.5


def test_a_mean_has_the_interval_of_its_errors(sweep: Sweep, tmp_path: Path):
    groups = {clip: clip[:7] for clip in CLIPS}
    runs = runs_of(sweep, fake_sweep(tmp_path, sweep, EFFECTS, groups=groups))
    found = cell(make_table(sweep, runs), "full_model", "MPJPE")
    errors = [r.get_clip_values(CLIPS, "stream", "rotation", "MPJPE") for r in runs["full_model"].values()]
    expected = estimate_paired_effects(np.array([errors]), [groups[clip] for clip in CLIPS])
    assert (found.low, found.high) == pytest.approx((expected.low[0], expected.high[0]))
    assert found.low < found.mean < found.high
    one = {label: dict(list(seeds.items())[:1]) for label, seeds in runs.items()}
    assert cell(make_table(sweep, one), "full_model", "MPJPE").low is not None  # over clips alone


def test_groups_with_a_higher_error_are_counted(sweep: Sweep, tmp_path: Path):
    groups = {clip: clip[-1:] for clip in CLIPS}
    runs = runs_of(sweep, fake_sweep(tmp_path, sweep, {}, groups=groups))
    effect = cell(make_table(sweep, runs), "no | memory", "MPJPE").effect
    sums = {group: [0.0, 0.0] for group in groups.values()}
    for side, label in enumerate(("no | memory", "full_model")):
        for run in runs[label].values():
            values = run.get_clip_values(CLIPS, "stream", "rotation", "MPJPE")
            for clip, value in zip(CLIPS, values, strict=True):
                sums[groups[clip]][side] += value
    above = sum(ours > theirs for ours, theirs in sums.values())
    assert 0 < above < len(sums)
    assert (effect.groups_above, effect.groups) == (above, len(sums))


def test_other_branches_have_the_effects_of_their_own_table(sweep: Sweep, tmp_path: Path):
    """Variant and control are in one branch, even if the row compares two branches."""
    runs = runs_of(sweep, fake_sweep(tmp_path, sweep, EFFECTS))
    rows = {row.label: row for row in make_table(sweep, runs).rows}
    assert set(rows["no | memory"].branches) == {"position", "combined"}
    assert set(rows["by position"].branches) == {"rotation", "position", "combined"}
    for branch in ("position", "combined"):
        own = replace(sweep, variants=tuple(replace(one, branch=branch) for one in sweep.variants))
        expected = compute_effects(own, runs, ("stream", "window"))
        found = rows["no | memory"].branches[branch]["stream"]
        assert found.keys() == {key.metric for key in expected if key[:2] == ("no | memory", "stream")} - {
            *COSTS
        }
        for metric, effect in found.items():
            other = expected["no | memory", "stream", metric]
            assert (effect.mean, effect.holm, effect.verdict) == (other.mean, other.holm, other.verdict)
    assert all(row.unrecorded == () for row in rows.values())


def test_a_branch_that_was_not_evaluated_is_named(sweep: Sweep, tmp_path: Path):
    runs = runs_of(sweep, fake_sweep(tmp_path, sweep, EFFECTS, branches=("rotation", "position")))
    table = make_table(sweep, runs)
    row = next(row for row in table.rows if row.label == "no | memory")
    assert (set(row.branches), row.unrecorded) == ({"position"}, ("combined",))
    assert "combined not recorded: every comparison" in make_legend(table)


def test_confounded_rows_are_counted_apart(sweep: Sweep, tmp_path: Path):
    runs = runs_of(sweep, fake_sweep(tmp_path, sweep, EFFECTS))
    before = make_table(sweep, runs)
    rows = tuple(
        replace(one, confounded="the loss too" if one.label == "no | memory" else None)
        for one in sweep.variants
    )
    after = make_table(replace(sweep, variants=rows), runs)
    assert after.count_verdicts("stream").total() == 0
    assert after.count_verdicts("stream", confounded=True) == before.count_verdicts("stream")
    assert before.count_verdicts("stream").total() == 2
    assert "no | memory ‡" in printed(after, 100)


def test_verdicts_follow_from_the_statistics(sweep: Sweep, tmp_path: Path):
    """Interval, correction, equivalence and verdict equal those that are put together here by hand."""
    find = fake_sweep(tmp_path, sweep, {"no | memory": 1.004, "by position": 1.05})
    table, runs, p = table_of(sweep, find), runs_of(sweep, find), {}
    keys = [("no | memory", "rotation", m) for m in ("MPJRE", "MPJPE", "Jitter")]
    keys += [("by position", "position", metric) for metric in ("MPJPE", "Jitter")]
    for mode, (label, branch, metric) in itertools.product(table.modes, keys):
        one, control = (
            np.array([read.get_clip_values(CLIPS, mode, b, metric) for read in runs[name].values()])
            for name, b in ((label, branch), ("full_model", "rotation"))
        )
        known = estimate_paired_effects((one - control)[None])
        effect = cell(table, label, metric, mode).effect
        expected = (known.mean[0], known.low[0], known.high[0])
        assert (effect.mean, effect.low, effect.high) == pytest.approx(expected)
        p[label, mode, metric] = known.p[0], compute_bootstrap_p((one - control)[None])[0]
    both = np.transpose([correct_by_holm(kind) for kind in np.transpose(list(p.values()))])
    corrected = dict(zip(p, both, strict=True))
    for (label, mode, metric), (value, second) in corrected.items():
        effect = cell(table, label, metric, mode).effect
        assert (effect.holm, effect.bootstrap) == pytest.approx((value, second))
        decided = (Verdict.HOLDS, Verdict.OPPOSITE, Verdict.HIGHER, Verdict.LOWER)
        assert (effect.verdict in decided) == (value <= 0.05 and not effect.equal <= 0.05)
    assert cell(table, "no | memory", "Jitter").effect.verdict == Verdict.EQUIVALENT


def test_another_branch_and_what_has_one_head(sweep: Sweep, tmp_path: Path):
    source = replace(sweep, branch_source="the text says so").with_branch("combined")
    find = fake_sweep(tmp_path, sweep)
    for seed in sweep.seeds:
        fake_run(tmp_path, f"{sweep.name} no | memory", seed, branches=["rotation"])
    table = table_of(source, find)
    rows = {row.label: row.branch for row in table.rows if not row.is_paper_only}
    assert rows == {"no | memory": "rotation", "by position": "position", "full_model": "combined"}
    assert len([flag for flag in table.flags if "row shows rotation: 'no | memory'" in flag]) == 1
    lines = " ".join(printed(table, 100).split())
    assert "rotation (position for 'by position'; combined for 'full_model')" in lines
    assert "the text says so" not in lines  # the paper's values are of another branch
    assert cell(table, "full_model", "MPJPE").paper is None
    verdicts = {row.cells["stream"]["MPJPE"].effect.verdict for row in table.rows[1:3]}
    assert verdicts <= {"higher", "lower", "inconclusive"}
    run = runs_of(source, find)["full_model"][0]
    assert cell(table, "full_model", "MPJPE").values[0] == run.get_value("stream", "combined", "MPJPE")


def test_variants_that_are_one_run_are_not_compared(sweep: Sweep, tmp_path: Path):
    """Compared with itself a variant would be equivalent with certainty, whatever the paper says."""
    runs = {seed: fake_run(tmp_path, "one", seed) for seed in sweep.seeds}
    table = table_of(sweep, lambda variant, seed: runs[seed])
    assert cell(table, "no | memory", "MPJPE").effect is None
    assert any("'no | memory' and 'full_model' are one run" in flag for flag in table.flags)
    assert cell(table, "by position", "MPJPE").effect is not None  # it shows another branch


@pytest.mark.parametrize(("label", "word"), [("no | memory", "nan"), ("full_model", "inf")])
def test_nothing_is_claimed_of_the_clips_that_a_divergence_leaves(sweep, tmp_path, label: str, word: str):
    """A variant that diverged on a hard clip would be better for it; too short a clip takes no verdict."""
    find = fake_sweep(tmp_path, sweep, EFFECTS)
    before = table_of(sweep, find)
    variant = next(variant for variant in sweep.variants if variant.label == label)
    for one, seed in [(one, seed) for one in sweep.list_runnable() for seed in sweep.seeds]:
        path = find(one, seed).evaluation("stream-0")
        report = json.loads(path.read_text())
        for branch in ("rotation", "position"):
            report["clips"][0][branch]["Jitter"] = "nan"  # of every run: it is too short
        if (one, seed) == (variant, 1):
            report["clips"][1]["rotation"] |= dict.fromkeys(("MPJPE", "MPJRE"), word)
        write_evaluation(path, report)
    table, lost = table_of(sweep, find), ("MPJPE", "MPJRE")
    assert all(cell(before, "no | memory", metric).effect.is_significant for metric in (*lost, "Jitter"))
    for metric in lost:
        effect = cell(table, "no | memory", metric).effect
        assert (effect.clips, effect.verdict, effect.is_significant) == (11, Verdict.INCONCLUSIVE, False)
        assert (effect.p, effect.equal, effect.detectable) == (None, None, None)
        assert cell(table, "no | memory", metric, "window").effect.is_significant
    assert cell(table, "no | memory", "Jitter").effect.clips == 11
    assert cell(table, "no | memory", "Jitter").effect.is_significant


@pytest.mark.parametrize("size", [1.66427, 0.0016469, 0.357113])
def test_equal_costs_differ_by_nothing_however_many_seeds_have_them(size: float):
    """Means in floating point are off by a rounding for some numbers of equal ones."""
    for seeds in range(1, 11):
        runs = dict.fromkeys(range(seeds), SimpleNamespace(costs={"parameters": size}))
        assert compute_mean_cost(runs, "parameters") == size
