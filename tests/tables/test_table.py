"""Tables of measured runs beside the paper's values."""

from __future__ import annotations

import functools
import io
import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fake_runs import CLIPS, ORIGIN, fake_run, fake_sweep, runs_of, table_of
from processes import finished
from rich.console import Console

from memmlp.common.errors import InputError
from memmlp.runs.evaluation_file import write_report
from memmlp.runs.run import Run
from memmlp.statistics import Verdict, holm, paired_effects
from memmlp.sweep.spec import Sweep, load_sweep, parse_sweep
from memmlp.tables.build_table import collect, without_runs
from memmlp.tables.formats import FORMATS, show
from memmlp.tables.measured_run import load
from memmlp.tables.seeds_needed import needs
from memmlp.tables.table import Effect, Table
from memmlp.tables.table_text import heading

SHIPPED = Path(__file__).parent.parent.parent / "sweeps"
FILE = {
    "title": "Memory & its <parts>",
    "table": 11,
    "notes": ["a note of the file"],
    "seeds": [0, 1, 2],
    "control": "full_model",
    "metrics": ["MPJRE", "MPJPE", "Jitter", "FLOPs", "ms"],
    "arms": {
        "a system": {"overrides": None, "paper": {"MPJPE": 4.0}},
        "no | memory": {"overrides": ["memory=none"], "paper": {"MPJRE": 2.76, "MPJPE": 3.0, "Jitter": 7.0}},
        "by position": {"branch": "position", "overrides": ["a=b"], "note": "as <printed>"},
        "full_model": {"overrides": [], "paper": {"MPJRE": 2.57, "MPJPE": 3.08, "Jitter": 7.0}},
    },
}  # fmt: skip
EFFECTS = {"no | memory": 1.2}


@pytest.fixture
def sweep() -> Sweep:
    return parse_sweep("table11", FILE)


@pytest.fixture
def table(sweep: Sweep, tmp_path: Path) -> Table:
    return table_of(sweep, fake_sweep(tmp_path, sweep, EFFECTS))


def cell(table: Table, label: str, metric: str, mode: str = "stream"):
    return next(row for row in table.rows if row.label == label).cells[mode][metric]


def printed(table: Table, width: int) -> str:
    console = Console(width=width, markup=False, highlight=False, file=io.StringIO())
    show(table, console)
    return console.file.getvalue()  # type: ignore[attr-defined]


def test_mean_and_sd_over_seeds(sweep: Sweep, table: Table, tmp_path: Path):
    runs = [Run(folder) for folder in (tmp_path / "runs").iterdir()]
    reports = [
        json.loads(run.evaluation("window-0").read_text())
        for run in runs
        if run.config["overrides"] == ["memory=none"]
    ]
    mine = [report["mean"]["rotation"]["MPJPE"] for report in reports]
    found = cell(table, "no | memory", "MPJPE", "window")
    assert sorted(found.values.values()) == sorted(mine)
    assert found.mean == pytest.approx(np.mean(mine))
    assert found.sd == pytest.approx(np.std(mine, ddof=1))


def test_difference_is_paired_by_seed_and_clip(sweep: Sweep, tmp_path: Path):
    """Effects that both arms share cancel: the interval is far narrower than the arms' own spread."""
    table = table_of(sweep, fake_sweep(tmp_path, sweep, EFFECTS))
    effect = cell(table, "no | memory", "MPJPE").effect
    assert effect is not None
    assert (effect.seeds, effect.clips, effect.groups) == (3, 12, 12)
    assert effect.low < effect.mean < effect.high
    means = [cell(table, label, "MPJPE").mean for label in ("no | memory", "full_model")]
    assert effect.mean == pytest.approx(means[0] - means[1])
    assert effect.mean == pytest.approx(0.2 * means[1], rel=0.1)
    assert effect.significant
    assert effect.high - effect.low < 0.5
    run = load(next((tmp_path / "runs").iterdir()))
    assert np.ptp(run.by_clip(CLIPS, "stream", "rotation", "MPJPE")) > 1.5


def test_correction_is_over_all_modes_and_metrics(table: Table):
    effects = [
        c.effect for row in table.rows for cells in row.cells.values() for c in cells.values() if c.effect
    ]
    tested = [effect for effect in effects if effect.p is not None]
    assert table.comparisons == len(tested) == 2 * 3 + 2 * 2  # the arm "by position" has no MPJRE
    smallest = min(tested, key=lambda effect: effect.p)
    assert smallest.holm == pytest.approx(min(1, smallest.p * len(tested)))


def test_signs_against_the_paper(table: Table):
    assert cell(table, "no | memory", "MPJRE").agrees is True  # +0.19 in the paper, worse here too
    assert cell(table, "no | memory", "MPJPE").agrees is False  # -0.08 in the paper
    assert cell(table, "no | memory", "Jitter").agrees is None  # no difference in the paper
    assert cell(table, "by position", "MPJPE").agrees is None  # not in the paper


def test_each_of_the_papers_effects_counts_once(table: Table):
    """The effects of one mode are counted: MPJRE holds, MPJPE does not, and for Jitter the paper has none."""
    assert table.verdicts("stream") == {Verdict.HOLDS: 1, Verdict.OPPOSITE: 1}
    assert cell(table, "no | memory", "Jitter").effect.verdict == Verdict.HIGHER
    assert "of 2 effects in stream mode: 1 holds, 1 opposite" in " ".join(printed(table, 100).split())


def test_verdicts_follow_from_the_statistics(sweep: Sweep, tmp_path: Path):
    """Interval, correction, equivalence and verdict equal those that are put together here by hand."""
    find = fake_sweep(tmp_path, sweep, {"no | memory": 1.004, "by position": 1.05})
    table, keys = (
        table_of(sweep, find),
        [("no | memory", "rotation", m) for m in ("MPJRE", "MPJPE", "Jitter")],
    )
    keys += [("by position", "position", metric) for metric in ("MPJPE", "Jitter")]
    p = {}
    for mode in table.modes:
        for label, branch, metric in keys:
            sides = [
                np.array(
                    [read.by_clip(CLIPS, mode, b, metric) for read in runs_of(sweep, find)[one].values()]
                )
                for one, b in ((label, branch), ("full_model", "rotation"))
            ]
            known = paired_effects((sides[0] - sides[1])[None])
            effect = cell(table, label, metric, mode).effect
            assert (effect.mean, effect.low, effect.high) == pytest.approx(
                (known.mean[0], known.low[0], known.high[0])
            )
            p[label, mode, metric] = known.p[0]
    corrected = dict(zip(p, holm(np.array(list(p.values()))), strict=True))
    for (label, mode, metric), value in corrected.items():
        effect = cell(table, label, metric, mode).effect
        assert effect.holm == pytest.approx(value)
        decided = (Verdict.HOLDS, Verdict.OPPOSITE, Verdict.HIGHER, Verdict.LOWER)
        assert (effect.verdict in decided) == (value <= 0.05 and not effect.equal <= 0.05)
    assert cell(table, "no | memory", "Jitter").effect.verdict == Verdict.EQUIVALENT


def test_groups_of_clips_widen_the_interval(sweep: Sweep, tmp_path: Path):
    groups = {clip: "one" if number < 6 else "other" for number, clip in enumerate(CLIPS)}
    effects = [
        cell(
            table_of(sweep, fake_sweep(tmp_path / name, sweep, EFFECTS, **words)), "no | memory", "MPJPE"
        ).effect
        for name, words in (("each", {}), ("two", {"groups": groups}))
    ]
    assert [effect.groups for effect in effects] == [12, 2]
    assert effects[1].high - effects[1].low > 1.5 * (effects[0].high - effects[0].low)


def test_a_row_has_its_own_control(sweep: Sweep, tmp_path: Path):
    arms = tuple(replace(arm, against="by position") if arm.paper else arm for arm in sweep.arms[1:3])
    chain = replace(sweep, arms=(*arms, *sweep.arms[3:]))
    table = table_of(chain, fake_sweep(tmp_path, chain, EFFECTS))
    means = [cell(table, label, "MPJPE").mean for label in ("no | memory", "by position")]
    found = cell(table, "no | memory", "MPJPE")
    assert found.effect.mean == pytest.approx(means[0] - means[1])
    assert found.paper_effect is None  # the paper has no value for the control
    assert "of 'no | memory' from 'by position'" in " ".join(printed(table, 200).split())


def test_one_head_is_told_by_its_positions(tmp_path: Path):
    """Without a position branch both branches have the errors of the rotations, up to rounding."""
    run = fake_run(tmp_path, "a")
    assert not load(run.folder).one_head
    for mode in ("stream", "window"):
        report = json.loads(run.evaluation(f"{mode}-0").read_text())
        mean = {"rotation": {"MPJPE": 26.688274383}, "position": {"MPJPE": 26.688272476}}
        write_report(run.evaluation(f"{mode}-0"), {"mode": mode, "mean": mean, "clips": report["clips"]})
    assert load(run.folder).one_head


def test_another_branch_and_what_has_one_head(sweep: Sweep, tmp_path: Path):
    source = replace(sweep, branch_source="the text says so").with_branch("combined")
    find = fake_sweep(tmp_path, sweep)
    for seed in sweep.seeds:
        fake_run(tmp_path, f"{sweep.name} no | memory", seed, branches=["rotation"])
    table = table_of(source, find)
    rows = {row.label: row.branch for row in table.rows if not row.paper_only}
    assert rows == {"no | memory": "rotation", "by position": "position", "full_model": "combined"}
    assert (
        sum("no other branch, so the row shows rotation: 'no | memory'" in flag for flag in table.flags) == 1
    )
    lines = " ".join(printed(table, 100).split())
    assert "combined; 'no | memory' rotation, 'by position' position" in lines
    assert "the text says so" not in lines  # the paper's values are of another branch
    assert cell(table, "full_model", "MPJPE").paper is None
    assert {row.cells["stream"]["MPJPE"].effect.verdict for row in table.rows[1:3]} <= {
        "higher",
        "lower",
        "open",
    }
    run = runs_of(source, find)["full_model"][0]
    assert cell(table, "full_model", "MPJPE").values[0] == run.value("stream", "combined", "MPJPE")


def test_a_branch_that_was_not_evaluated_is_no_other(sweep: Sweep, tmp_path: Path):
    """A network with two heads and no inverse kinematics yet is not shown by its rotation branch instead."""
    find = fake_sweep(tmp_path, sweep, branches=["rotation", "position"])
    table = table_of(sweep.with_branch("combined"), find, command="memmlp sweep 11")
    assert cell(table, "full_model", "MPJPE").mean is None
    assert (
        "not evaluated in the branch combined: 'no | memory', 'full_model'; do so with: memmlp sweep 11"
        in (table.flags)
    )


def test_what_the_table_could_have_seen(table: Table, sweep: Sweep, tmp_path: Path):
    """A table could have seen the largest of what its arms could, and here a larger effect."""
    least = [cell(table, label, "MPJPE").effect.detectable for label in ("no | memory", "by position")]
    assert table.detectable("stream", "MPJPE") == max(least)
    assert f"MPJPE: could have seen {max(least):.2g} (stream)" in printed(table, 200)
    assert cell(table, "no | memory", "MPJPE").effect.mean > least[0]


def test_seeds_that_the_papers_effects_need(sweep: Sweep, tmp_path: Path):
    find = fake_sweep(tmp_path, sweep)
    found = {(n.label, n.mode, n.metric): n for n in needs(sweep, runs_of(sweep, find))}
    assert {key[::2] for key in found} == {("no | memory", "MPJRE"), ("no | memory", "MPJPE")}
    big = replace(sweep.arms[1], paper={"MPJRE": 9.0, "MPJPE": 9.0})
    louder = replace(sweep, arms=(sweep.arms[0], big, *sweep.arms[2:]))
    fewer = {(n.label, n.mode, n.metric): n for n in needs(louder, runs_of(louder, find))}
    for key, need in found.items():
        assert need.have == 3
        assert fewer[key].seeds <= (need.seeds or 1000)
    assert fewer["no | memory", "stream", "MPJPE"].seeds <= 3 < found["no | memory", "stream", "MPJPE"].seeds
    assert needs(replace(sweep, seeds=(0,)), runs_of(replace(sweep, seeds=(0,)), find)) == []
    one = fake_sweep(tmp_path / "one", sweep, groups=dict.fromkeys(CLIPS, "one"))
    assert needs(sweep, runs_of(sweep, one)) == []


def test_costs_come_from_the_latency(table: Table):
    assert cell(table, "full_model", "FLOPs").mean == pytest.approx(0.026)
    assert cell(table, "no | memory", "ms").mean == pytest.approx(0.96)
    assert cell(table, "no | memory", "ms").effect == Effect(pytest.approx(0.16))


def test_costs_have_the_tables_units(tmp_path: Path):
    costs = load(fake_run(tmp_path, "run").folder).costs
    sizes = {"FLOPs": 0.026, "MACs": 0.013, "parameters": 0.356798, "size": 1.9}
    assert costs == pytest.approx({**sizes, "ms": 0.8, "ratio": 0.6, "FPS": 1250})


def test_a_branch_without_rotations_has_no_mpjre(table: Table):
    assert cell(table, "by position", "MPJRE").mean is None
    assert cell(table, "by position", "MPJPE").mean is not None


def test_missing_runs_are_shown_with_the_command(sweep: Sweep, tmp_path: Path):
    find = fake_sweep(tmp_path, sweep)
    unfinished = find(sweep.arms[1], 1)
    assert unfinished is not None
    unfinished.marker.unlink()
    unfinished.fail("loss is NaN")
    gone = {("by position", seed) for seed in (0, 1, 2)}
    table = table_of(
        sweep,
        lambda arm, seed: None if (arm.label, seed) in gone else find(arm, seed),
        command="memmlp sweep 11 data=mocap",
    )
    rows = {row.label: row for row in table.rows}
    assert (rows["no | memory"].found, rows["by position"].found) == ((0, 2), ())
    gaps = "'no | memory' seed 1 (failed), 'by position' seed 0, 1, 2"
    assert f"missing: {gaps}; fill with: memmlp sweep 11 data=mocap" in table.flags
    effect = cell(table, "no | memory", "MPJPE").effect
    assert effect is not None
    assert effect.seeds == 2
    assert cell(table, "by position", "MPJPE").effect is None
    assert "2/3" in printed(table, 100)
    assert "0/3" in FORMATS["md"](table)


def test_no_control_no_differences(sweep: Sweep, tmp_path: Path):
    find = fake_sweep(tmp_path, sweep)
    table = table_of(sweep, lambda arm, seed: None if arm.label == "full_model" else find(arm, seed))
    assert table.comparisons == 0
    assert all(c.effect is None for row in table.rows for cells in row.cells.values() for c in cells.values())


def test_unequal_clips_are_flagged_and_left_out(sweep: Sweep, tmp_path: Path):
    runs = {
        (arm.label, seed): fake_run(
            tmp_path, arm.label, seed, clips=CLIPS[:3] if arm.label == "full_model" else CLIPS[1:4]
        )
        for arm in sweep.runnable()
        for seed in (0, 1)
    }
    table = table_of(replace(sweep, seeds=(0, 1)), lambda arm, seed: runs[arm.label, seed])
    effect = cell(table, "no | memory", "MPJPE").effect
    assert effect is not None
    assert effect.clips == 2
    assert abs(effect.mean) < 0.3  # the clip that is far harder than the others is in one arm alone
    assert sum("unequal test clips" in flag and "share 2 of 4" in flag for flag in table.flags) == 2


def test_a_clip_that_is_no_number_is_left_out(sweep: Sweep, tmp_path: Path):
    find = fake_sweep(tmp_path, sweep)
    run = find(sweep.arms[3], 1)
    assert run is not None
    path = run.evaluation("stream-0")
    report = json.loads(path.read_text())
    report["clips"][0]["rotation"]["Jitter"] = "nan"
    write_report(path, {key: report[key] for key in ("mode", "mean", "clips")})
    table = table_of(sweep, find)
    assert [cell(table, "no | memory", metric).effect.clips for metric in ("Jitter", "MPJPE")] == [11, 12]


@pytest.mark.parametrize("word", ["nan", "inf"])
def test_a_network_that_diverged_on_a_clip_is_said(sweep: Sweep, tmp_path: Path, word: str):
    """What its arm is compared by are the clips where it did not; too short a clip is so for every run."""
    find = fake_sweep(tmp_path, sweep)
    for arm in sweep.runnable():
        for seed in sweep.seeds:
            path = find(arm, seed).evaluation("stream-0")
            report = json.loads(path.read_text())
            for branch in ("rotation", "position"):
                report["clips"][0][branch]["Jitter"] = "nan"
            for number in (1, 2) if (arm.label, seed) == (sweep.arms[3].label, 1) else ():
                report["clips"][number]["rotation"]["MPJPE"] = word
            path.write_text(json.dumps(report))
    table = table_of(sweep, find)
    assert [cell(table, "no | memory", metric).effect.clips for metric in ("Jitter", "MPJPE")] == [11, 10]
    line = (
        "errors that are no numbers, of clips that are left out of differences: 'full_model' seed 1 (2 clips)"
    )
    assert [flag for flag in table.flags if "no numbers" in flag] == [line]


def test_groups_that_differ_between_runs_are_said(sweep: Sweep, tmp_path: Path):
    find = fake_sweep(tmp_path, sweep, groups={clip: f"take {i // 2}" for i, clip in enumerate(CLIPS)})
    assert not any("data.split.groups" in flag for flag in table_of(sweep, find).flags)
    for path in find(sweep.runnable()[0], 1).evaluations.glob("*.json"):
        report = json.loads(path.read_text())
        report["clips"][0]["group"] = "alone"
        path.write_text(json.dumps(report))
    assert any("runs differ in the groups of test clips" in flag for flag in table_of(sweep, find).flags)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"git": {"commit": "fedcba9876543210", "dirty": False}}, ("code differs", "fedcba9", "0123456")),
        ({"git": ORIGIN["git"] | {"dirty": True}}, ("uncommitted changes", "'by position'")),
        ({"data": "e" * 64}, ("data differs", "dddddddd of 'no | memory', 'full_model'", "eeeeeeee of 'by")),
        ({"cpu": "Another one"}, ("hardware differs", "Another one of 'by position'")),
        ({"git": None}, ("code differs", "version 0.3.0 of 'by position'")),
        ({"device": "cuda"}, ("device differs", "cuda of 'by position'", "cpu of 'no | memory'")),
        ({"gpu": "A card"}, ("GPU differs", "A card of 'by position'")),
        ({"threads": 2}, ("threads differs", "2 of 'by position'")),
        ({"packages": {"torch": "3.0"}}, ("torch differs", "3.0 of 'by position'")),
        ({"precision": "bf16"}, ("precision differs", "bf16 of 'by position'")),
        ({"recipes": {"memory": 2}}, ("recipe of memory differs", "2 of 'by position'")),
    ],
)  # fmt: skip
def test_runs_of_different_origin_are_flagged(
    sweep: Sweep, tmp_path: Path, change: dict, words: tuple[str, ...]
):
    runs = {
        arm.label: fake_run(tmp_path, arm.label, origin=change if arm.label == "by position" else None)
        for arm in sweep.runnable()
    }
    table = table_of(replace(sweep, seeds=(0,)), lambda arm, seed: runs[arm.label])
    flags = [flag for flag in table.flags if words[0] in flag]
    assert len(flags) == 1
    assert all(word in flags[0] for word in words)
    assert any("one seed" in flag for flag in table.flags)


def test_equal_origins_are_not_flagged(table: Table):
    assert [flag for flag in table.flags if "a group of its own" not in flag] == []


def test_what_an_evaluation_ran_on_counts_too(sweep: Sweep, tmp_path: Path):
    """An evaluation's numbers depend on code and device as the weights do."""
    other = {"device": "cuda:0", "made_by": {**ORIGIN, "git": {"commit": "fedcba98", "dirty": True}}}
    runs = {
        arm.label: fake_run(tmp_path, arm.label, evaluated=other if arm.label == "by position" else None)
        for arm in sweep.runnable()
    }
    said = " ".join(table_of(replace(sweep, seeds=(0,)), lambda arm, seed: runs[arm.label]).flags)
    assert "0123456, fedcba9 of 'by position'" in said
    assert ", cuda:0 of 'by position'" in said
    assert "uncommitted changes: 'by position'" in said


def test_arms_that_are_one_run_are_not_compared(sweep: Sweep, tmp_path: Path):
    """Compared with itself an arm would be equivalent with certainty, whatever the paper says."""
    runs = {seed: fake_run(tmp_path, "one", seed) for seed in sweep.seeds}
    table = table_of(sweep, lambda arm, seed: runs[seed])
    assert cell(table, "no | memory", "MPJPE").effect is None
    assert any("'no | memory' and 'full_model' are one run" in flag for flag in table.flags)
    assert cell(table, "by position", "MPJPE").effect is not None  # it shows another branch


def test_a_comparison_of_one_seed_among_others_of_more_is_said(sweep: Sweep, tmp_path: Path):
    find = fake_sweep(tmp_path, sweep)
    table = table_of(sweep, lambda arm, seed: find(arm, seed) if seed == 0 or "no" not in arm.label else None)
    assert sum(flag.startswith("one seed, so that") and "'no | memory'" in flag for flag in table.flags) == 1


def test_recipes_of_what_only_some_arms_have_do_not_differ(sweep: Sweep, tmp_path: Path):
    recipes = {"by position": {"recipes": {"memory": 1, "gru": 7}}}
    runs = {
        arm.label: fake_run(tmp_path, arm.label, origin=recipes.get(arm.label)) for arm in sweep.runnable()
    }
    table = table_of(replace(sweep, seeds=(0,)), lambda arm, seed: runs[arm.label])
    assert not any("recipe" in flag for flag in table.flags)


@pytest.mark.parametrize(("shared", "flagged"), [(True, 1), (False, 0)])
def test_seeds_that_share_a_vqvae_are_flagged(sweep: Sweep, tmp_path: Path, shared: bool, flagged: int):
    runs = {
        (arm.label, seed): fake_run(
            tmp_path, arm.label, seed, origin={"upstream": "v" if shared else f"v{seed}"}
        )
        for arm in sweep.runnable()
        for seed in sweep.seeds
    }
    table = table_of(sweep, lambda arm, seed: runs[arm.label, seed])
    lines = [flag for flag in table.flags if "share one VQ-VAE" in flag]
    assert len(lines) == flagged
    assert all("'no | memory', 'by position', 'full_model'" in line for line in lines)


def test_one_group_of_clips_is_said_and_starred_by_nobody(sweep: Sweep, tmp_path: Path):
    find = fake_sweep(tmp_path, sweep, {"no | memory": 2.0}, groups=dict.fromkeys(CLIPS, "one"))
    table = table_of(sweep, find)
    assert any("one group of test clips" in flag for flag in table.flags)
    assert table.comparisons == 0
    effect = cell(table, "no | memory", "MPJPE").effect
    assert (effect.significant, effect.verdict) == (False, Verdict.OPEN)
    assert "*" not in printed(table, 100)


@pytest.mark.parametrize(
    ("number", "body", "flagged"), [(1, "builtin", 1), (1, "SMPL-H", 0), (4, "builtin", 0)]
)
def test_the_built_in_body_beside_smplh_numbers(
    sweep: Sweep, tmp_path: Path, number: int, body: str, flagged: int
):
    sweep = replace(sweep, table=number)
    table = table_of(sweep, fake_sweep(tmp_path, sweep, origin={"body": body}))
    assert sum("data.body" in flag for flag in table.flags) == flagged


def test_runs_of_an_older_recipe_are_named(sweep: Sweep, tmp_path: Path):
    runs = runs_of(sweep, fake_sweep(tmp_path, sweep))
    runs["no | memory"] = {seed: run for seed, run in runs["no | memory"].items() if seed}
    table = collect(sweep, runs, older=lambda arm, seed: "abc" if arm.label != "full_model" else None)
    assert "made by an earlier recipe, left out and made again by the sweep: 'no | memory' seed 0 (abc)" in (
        table.flags
    )


def test_damaged_results_are_one_line(tmp_path: Path, sweep: Sweep):
    find = fake_sweep(tmp_path, sweep)
    run = find(sweep.arms[3], 1)
    assert run is not None
    for text in ("[{", "[5]", "{}"):
        run.evaluation("stream-0").write_text(text)
        with pytest.raises(InputError, match=re.escape(str(run.evaluation("stream-0")))):
            table_of(sweep, find)


def test_costs_that_are_no_numbers_are_left_out(tmp_path: Path):
    run = fake_run(tmp_path, "a")
    path = run.deployment("fp32-0").latency
    path.write_text(json.dumps(json.loads(path.read_text()) | {"flops": "nan"}))
    costs = load(run.folder).costs
    assert "FLOPs" not in costs
    assert "parameters" in costs


def test_the_evaluations_of_a_table_are_its_own(tmp_path: Path):
    """Where a run has two evaluations of one mode, each table reads the one that it asks for."""
    run = fake_run(tmp_path, "a")
    report = json.loads(run.evaluation("stream-0").read_text())
    other = {"mode": "stream", "mean": {"combined": {"MPJPE": 1.0}}, "clips": report["clips"]}
    write_report(run.evaluation("stream-1"), other)
    assert load(run.folder, ["stream-0"]).value("stream", "combined", "MPJPE") != 1.0
    assert load(run.folder, ["stream-1"]).value("stream", "combined", "MPJPE") == 1.0
    assert load(run.folder, ["stream-1"]).value("stream", "rotation", "MPJPE") is None


def test_only_costs_need_one_block(tmp_path: Path):
    sweep = load_sweep(SHIPPED / "table16.yaml")
    table = table_of(sweep, fake_sweep(tmp_path, sweep))
    assert len(table.modes) == 1
    assert not {"stream mode", "window mode"} & set(printed(table, 100).splitlines())
    assert table.flags == ()


def test_costs_show_how_many_times_the_controls_they_are(tmp_path: Path):
    """The fake arms take 0.8, 0.88 and 0.96 ms, the paper's 6.0 and 30.1 ms."""
    sweep = load_sweep(SHIPPED / "table17.yaml")
    text = printed(table_of(sweep, fake_sweep(tmp_path, sweep)), 100)
    table = table_of(sweep, fake_sweep(tmp_path, sweep))
    ms = [row.cells[table.modes[0]]["ms"].mean for row in table.rows]
    assert f"(x {ms[1] / ms[0]:.3g})" in text
    assert f"(x {30.1 / 6.0:.3g})" in text


def test_heads_tell_unit_and_direction():
    assert [heading(name) for name in ("Jitter", "ms", "FPS")] == ["Jitter [10² m/s³] ↓", "ms ↓", "FPS ↑"]


def test_long_labels_fold_so_that_four_metrics_fit(tmp_path: Path):
    sweep = load_sweep(SHIPPED / "table04.yaml")
    assert printed(table_of(sweep, fake_sweep(tmp_path, sweep)), 100).count("Jitter ↓") == 2


@pytest.mark.parametrize("width", [80, 100])
@pytest.mark.parametrize("path", sorted(SHIPPED.glob("*.yaml")), ids=lambda path: path.stem)
def test_shipped_tables_fit_the_screen(tmp_path: Path, path: Path, width: int):
    sweep = load_sweep(path)
    text = printed(table_of(sweep, fake_sweep(tmp_path, sweep)), width)
    assert max(map(len, text.splitlines())) <= width
    for arm in sweep.arms:
        assert arm.label.split()[0] in text
        for value in (arm.paper or {}).values():
            assert f"{value:.1f}" in text or f"{value:.2f}" in text
    assert text.count(f"{len(sweep.seeds)}/{len(sweep.seeds)}") >= len(sweep.runnable())


def test_screen_shows_everything_of_an_arm(table: Table):
    lines = [line.split("  ") for line in printed(table, 100).splitlines()]
    words = [[word.strip() for word in line if word.strip()] for line in lines]
    start = next(i for i, line in enumerate(words) if line[:1] == ["no | memory"])
    assert words[start][1] == "3/3"
    assert re.fullmatch(r"\d\.\d\d ± \d\.\d\d", words[start][2])
    assert re.fullmatch(r"\+\d\.\d+\*", words[start + 1][1])
    assert re.fullmatch(r"\[\d\.\d+, \d\.\d+\]", words[start + 2][0])
    assert words[start + 3][:3] == ["holds", "opposite", "higher"]
    assert words[start + 4][:3] == ["paper", "2.76 (+0.19 ✓)", "3.00 (−0.08 ✗)"]  # noqa: RUF001
    assert ["a system", "paper", "-", "4.00", "-", "-", "-"] in words


def test_markdown_escapes(table: Table):
    text = FORMATS["md"](table)
    rows = [re.split(r"(?<!\\)\|", line) for line in text.splitlines() if line.startswith("|")]
    assert {len(row) for row in rows} == {2 + 2 + 5}
    assert r"no \| memory" in text
    assert r"full\_model" in text
    assert r"\<parts\>" in text
    assert "a note of the file" in text
    assert r"by position: as \<printed\>" in text


def test_latex_escapes(table: Table):
    text = FORMATS["tex"](table)
    assert r"Memory \& its $<$parts$>$" in text
    assert r"full\_model" in text
    assert text.count(r"\toprule") == text.count(r"\bottomrule") == 1
    assert not re.search(r"[±−↓↑✓✗²³]", text)  # noqa: RUF001
    rows = [line for line in text.splitlines() if line.endswith(r"\\") and "multicolumn" not in line]
    assert {len(re.split(r"(?<!\\)&", row)) for row in rows} == {7}


def test_html_escapes(table: Table):
    text = FORMATS["html"](table)
    assert "Memory &amp; its &lt;parts&gt;" in text
    assert "<parts>" not in text
    assert text.count("<tbody>") == 2 * 4
    assert '<span class="opposite">✗</span>' in text


def test_json_has_the_values_of_each_seed(table: Table):
    content = json.loads(FORMATS["json"](table))
    found = content["rows"][1]["cells"]["stream"]["MPJPE"]
    expected = cell(table, "no | memory", "MPJPE")
    assert found["values"] == {str(seed): value for seed, value in expected.values.items()}
    assert found["effect"]["holm"] == expected.effect.holm
    assert (found["agrees"], found["paper"]) == (False, 3.0)
    assert content["rows"][0]["wanted"] == []


def test_collect_reads_each_run_once(sweep: Sweep, tmp_path: Path):
    """The work is linear in the runs: each is read once, though it is in many comparisons."""
    many = parse_sweep("many", {"axes": {"optim.lr": list(range(1, 41))}, "seeds": [0, 1]})
    find, opened = fake_sweep(tmp_path, many), []

    def counted(folder: Path):
        opened.append(folder)
        return load(folder)

    runs_of(many, find, functools.cache(counted))
    assert len(opened) == len(set(opened)) == 80


def test_tables_need_no_torch():
    """Tables need no scipy.stats, matplotlib or Hydra either, for these take seconds to import."""
    code = "import sys, memmlp.cli.table, memmlp.tables.formats as r; print(*sys.modules)"
    ran = finished([sys.executable, "-c", code])
    assert ran.returncode == 0, ran.stderr
    assert not {"torch", "scipy.stats", "matplotlib", "hydra"} & set(ran.stdout.split())


def test_without_runs_the_papers_values_and_the_reason_are_shown():
    table = without_runs(
        load_sweep(SHIPPED / "table01.yaml"), ("stream", "window"), "nothing measured: data.root"
    )
    text = printed(table, 100)
    assert "nothing measured: data.root" in text
    assert "14.27" in text
    assert "missing" not in text


def test_the_correction_is_the_same_whichever_mode_is_shown(sweep: Sweep, tmp_path: Path):
    """Nobody gets a star by looking at one mode alone."""
    find = fake_sweep(tmp_path, sweep, EFFECTS)
    both, one = table_of(sweep, find), table_of(sweep, find, modes=("stream",))
    assert one.modes == ("stream",)
    assert one.comparisons == both.comparisons
    for label, metric in (("no | memory", "MPJPE"), ("by position", "Jitter")):
        assert cell(one, label, metric).effect == cell(both, label, metric).effect
