"""From a sweep and its runs to a table."""

import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fake_runs import CLIPS, fake_sweep, runs_of
from processes import finished

from memmlp.common.errors import InputError
from memmlp.report.tables.build_table import (
    group_clips,
    make_table,
    restrict_and_group_clips,
    restrict_to_source,
)
from memmlp.sweep.sweep_file import parse_sweep


def test_tables_need_no_torch():
    """Tables need no scipy.stats, matplotlib or Hydra either, for these take seconds to import."""
    code = "import sys, memmlp.cli.table, memmlp.report.tables.table_text as r; print(*sys.modules)"
    ran = finished([sys.executable, "-c", code])
    assert ran.returncode == 0, ran.stderr
    assert not {"torch", "scipy.stats", "matplotlib", "hydra"} & set(ran.stdout.split())


def test_variants_without_a_sources_clips_are_left_out_and_named(tmp_path: Path):
    """The control has clips of one source alone: on the other's, the next variant stands in its place."""
    more = {"overrides": ["optim.lr=2"], "against": "one"}
    sweep = parse_sweep("mix", {"variants": {"one": [], "both": ["optim.lr=1"], "more": more}})
    halves = {clip: "old" if number % 2 else "new" for number, clip in enumerate(CLIPS)}
    runs = {
        label: {
            seed: replace(run, clip_sources=dict.fromkeys(CLIPS, "old") if label == "one" else halves)
            for seed, run in found.items()
        }
        for label, found in runs_of(sweep, fake_sweep(tmp_path, sweep)).items()
    }
    part, part_runs, flags = restrict_to_source(sweep, runs, "new")
    assert (list(part_runs), part.control) == (["both", "more"], "both")
    assert flags == ("no test clip of new, so left out: 'one'",)
    waiting, left, _ = restrict_to_source(sweep, runs | {"both": {}}, "new")
    assert (list(left), waiting.control) == (["both", "more"], "more")  # one without a run is no control
    table = make_table(part, part_runs)
    assert [row.label for row in table.rows] == ["both", "more"]
    assert not any("missing" in flag for flag in table.flags)
    old, old_runs, flags = restrict_to_source(sweep, runs, "old")
    assert (list(old_runs), old.variants, flags) == (["one", "both", "more"], sweep.variants, ())
    assert "test clips of old alone" in old.title
    assert all(len(run.clips) == len(CLIPS) // 2 for run in old_runs["both"].values())
    with pytest.raises(InputError, match=r"--source third: no finished run .* must be new or old"):
        restrict_to_source(sweep, runs, "third")


def test_groups_of_equal_weight_are_like_clips(tmp_path: Path):
    """A table by hand: the means of each group's clips are the errors of one clip."""
    sweep = parse_sweep("two", {"variants": {"one": [], "other": ["optim.lr=1"]}, "seeds": [0, 1, 2]})
    groups = {clip: clip.split("/")[0] if "kicks" in clip else clip[-1] for clip in CLIPS}
    runs = runs_of(sweep, fake_sweep(tmp_path, sweep, {"other": 1.1}, groups=groups))
    _, averaged, flags = restrict_and_group_clips(sweep, runs, None, (), weigh_groups=True)
    assert flags == ("each group of test clips has the same weight",)
    names = sorted(set(groups.values()))
    for label, seeds in runs.items():
        for seed, run in seeds.items():
            values = dict(zip(CLIPS, run.get_clip_values(CLIPS, "stream", "rotation", "MPJPE"), strict=True))
            means = [np.mean([values[clip] for clip in CLIPS if groups[clip] == name]) for name in names]
            found = averaged[label][seed]
            assert list(found.get_clip_values(names, "stream", "rotation", "MPJPE")) == pytest.approx(means)
            assert found.get_value("stream", "rotation", "MPJPE") == pytest.approx(np.mean(means))
    tables = [make_table(sweep, one) for one in (runs, averaged)]
    assert not any("of its own" in flag for table in tables for flag in table.flags)
    effects = [table.rows[1].cells["stream"]["MPJPE"].effect for table in tables]
    assert [(one.clips, one.groups) for one in effects] == [
        (len(CLIPS), len(names)),
        (len(names), len(names)),
    ]


def test_groups_of_equal_weight_need_the_same_clips_in_all_runs(tmp_path: Path):
    sweep = parse_sweep("two", {"variants": {"one": [], "other": ["optim.lr=1"]}, "seeds": [0]})
    runs = runs_of(sweep, fake_sweep(tmp_path, sweep, {}))
    fewer = runs | {"other": {0: runs["other"][0].restrict_to_clips(CLIPS[1:])}}
    with pytest.raises(InputError, match=r"^--weigh-groups: all runs must have the same test clips"):
        restrict_and_group_clips(sweep, fewer, None, (), weigh_groups=True)


def test_a_group_with_a_clip_on_which_a_network_diverged_has_no_mean(tmp_path: Path):
    sweep = parse_sweep("one", {"variants": {"one": []}, "seeds": [0]})
    groups = {clip: clip.split("/")[0] for clip in CLIPS}
    run = runs_of(sweep, fake_sweep(tmp_path, sweep, {}, groups=groups))["one"][0]
    errors = {metric: math.nan for metric in run.clips["kicks/01"]["stream"]["rotation"]}
    lost = replace(run, clips={**run.clips, "kicks/01": {"stream": {"rotation": errors}}}).average_groups()
    values = lost.get_clip_values(["kicks", "salsa"], "stream", "rotation", "MPJPE")
    assert list(np.isnan(values)) == [True, False]


def test_clips_that_are_put_together_count_as_those_that_the_data_has_together(tmp_path: Path):
    """Patterns add to the groups that there are: pairs of salsas stay together where kicks come together."""
    sweep = parse_sweep("two", {"variants": {"one": [], "other": ["optim.lr=1"]}, "seeds": [0, 1, 2]})
    pairs = {clip: f"pair {int(clip[-2:]) // 2}" if "salsa" in clip else clip for clip in CLIPS}
    wanted = {**pairs, "kicks/01": "kicks", "kicks/02": "kicks"}
    effects = {"other": 1.1}
    own = runs_of(sweep, fake_sweep(tmp_path / "own", sweep, effects, groups=pairs))
    coarser = runs_of(sweep, fake_sweep(tmp_path / "coarser", sweep, effects, groups=wanted))
    found, flags = group_clips(own, ["^(kicks)/"])
    assert flags == (
        "--together merged 8 groups of test clips into 7: clips with equal matches of '^(kicks)/' form a "
        "group",
    )
    cells = [row.cells for row in make_table(sweep, coarser).rows]
    assert [row.cells for row in make_table(sweep, found).rows] == cells
    assert [row.cells for row in make_table(sweep, own).rows] != cells
    assert group_clips(own, []) == (own, ())
    with pytest.raises(InputError, match=r"^--together \(nothing\): must match clips in different groups"):
        group_clips(own, ["^(kicks)/", "(nothing)"])
    with pytest.raises(InputError, match=r"^--together kicks: must have \(parentheses\)"):
        group_clips(own, ["kicks"])
    with pytest.raises(InputError, match=r"^--together \(: .*regular expression"):
        group_clips(own, ["("])
