"""Sweep files: what they mean, and the one-line errors about what they must not hold."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from memmlp.common.errors import InputError
from memmlp.evaluation.units import SMALLEST, UNITS
from memmlp.sweep import spec
from memmlp.sweep.spec import load_sweep, parse_sweep

ARMS = {"full": [], "none": {"overrides": ["memory=none"], "paper": {"MPJPE": 4.13}}}


def test_jobs_are_arms_by_seeds_with_base_and_difference():
    sweep = parse_sweep("s", {"base": ["profile=tiny"], "seeds": [0, 2], "arms": ARMS})
    assert [(one.label, one.seed, one.overrides) for one in sweep.arm_seeds()] == [
        ("full", 0, ("profile=tiny", "seed=0")),
        ("full", 2, ("profile=tiny", "seed=2")),
        ("none", 0, ("profile=tiny", "memory=none", "seed=0")),
        ("none", 2, ("profile=tiny", "memory=none", "seed=2")),
    ]


def test_the_command_line_stands_over_the_base_and_beside_the_arm():
    content = {"base": ["model.depth=8"], "arms": {"wide": ["model.width=10"], "base": []}}
    sweep = parse_sweep("s", content).with_overrides(["model.depth=4", "optim.lr=1"])
    assert set(sweep.overrides(sweep.arms[0])) == {"model.width=10", "model.depth=4", "optim.lr=1"}
    assert set(sweep.overrides(sweep.arms[1])) == {"model.depth=4", "optim.lr=1"}


@pytest.mark.parametrize("word", ["memory.layers=[2]", "+memory.layers=[9]", "~hand"])
def test_a_key_that_an_arm_sets_is_refused_on_the_command_line(word: str):
    """The arm's own value would stand, and the override would be lost without a word."""
    content = {"arms": {"two": ["memory.layers=[2]"], "no hand": ["hand=off"], "all": []}}
    with pytest.raises(InputError, match=r"arm '(two|no hand)' of sweep s sets .* itself; allowed are keys"):
        parse_sweep("s", content).with_overrides(["profile=tiny", word])
    content["arms"]["two"] = content["arms"]["no hand"] = {"overrides": None}  # rows of the paper alone
    assert parse_sweep("s", content).with_overrides([word]).extra == (word,)


def test_seeds_of_the_command_line_replace_the_files():
    sweep = parse_sweep("s", {"seeds": [0, 1], "arms": ARMS}).with_overrides(["seed=5,6,7", "profile=tiny"])
    assert sweep.seeds == (5, 6, 7)
    assert sweep.extra == ("profile=tiny",)


def test_the_outputs_folder_is_an_option_and_no_override():
    sweep = parse_sweep("s", {"seeds": [0], "arms": ARMS})
    with pytest.raises(InputError, match=r"paths\.outputs: allowed here is --outputs"):
        sweep.with_overrides(["profile=tiny", "paths.outputs=elsewhere"])


def test_axes_are_a_grid_over_every_arm():
    axes = {"model.frames": [11, 21], "memory.layers": [[2], [2, 4]], "seed": [3, 4]}
    sweep = parse_sweep("s", {"arms": {"a": ["loss=manual"]}, "axes": axes})
    assert sweep.seeds == (3, 4)
    assert len(sweep.arms) == 4
    assert sweep.arms[1].label == "a, model.frames=11, memory.layers=[2,4]"
    assert sweep.arms[1].overrides == ("loss=manual", "model.frames=11", "memory.layers=[2,4]")
    printed = parse_sweep("s", {"arms": {"theirs": {"overrides": None}, "a": []}, "axes": axes})
    assert [arm.label for arm in printed.arms if arm.overrides is None] == ["theirs"]
    assert len(printed.runnable()) == 4
    seeds = parse_sweep("s", {"axes": {"seed": [5, 6]}})
    assert [(arm.label, arm.overrides) for arm in seeds.arms] == [("base", ())]
    assert seeds.seeds == (5, 6)
    alone = parse_sweep("s", {"axes": {"model.frames": [11, 21]}})
    assert [arm.label for arm in alone.arms] == ["model.frames=11", "model.frames=21"]


def test_rows_of_the_paper_alone_are_not_run():
    sweep = parse_sweep("s", {"arms": {"AvatarPoser": {"overrides": None}, "ours": []}})
    assert [one.label for one in sweep.arm_seeds()] == ["ours"]
    assert sweep.control == "ours"


def test_arms_show_the_sweeps_branch_or_their_own_and_another_where_asked():
    arms = {"full": [], "one head": {"overrides": ["memory=none"], "branch": "rotation"}}
    content = {"branch": "combined", "branch_source": "Table 6", "arms": arms}
    sweep = parse_sweep("s", content)
    assert [arm.branch for arm in sweep.arms] == ["combined", "rotation"]
    assert sweep.branch_source == "Table 6"
    assert [arm.branch for arm in sweep.with_branch("position").arms] == ["position", "rotation"]
    with pytest.raises(InputError, match="branch: 'hips'; allowed are rotation, position, combined"):
        sweep.with_branch("hips")
    plain = parse_sweep("s", {"arms": ARMS, "axes": {"model.frames": [11]}})
    assert {arm.branch for arm in plain.arms} == {"rotation"}
    assert plain.branch_source is None
    grid = parse_sweep("s", {"branch": "position", "axes": {"model.frames": [11]}})
    assert [arm.branch for arm in grid.arms] == ["position"]


def test_an_arm_is_compared_with_the_sweeps_control_or_with_its_own_control():
    arms = {"a": [], "b": {"against": "a"}, "c": {"overrides": ["loss=manual"], "against": "b"}, "d": []}
    sweep = parse_sweep("s", {"arms": arms, "control": "d"})
    assert [sweep.control_of(arm) for arm in sweep.arms] == ["d", "a", "b", None]
    grid = parse_sweep("s", {"arms": arms, "axes": {"model.frames": [11, 21]}})
    assert grid.arms[3].label == "b, model.frames=21"
    assert grid.control_of(grid.arms[3]) == "a, model.frames=21"


def test_every_metric_has_a_smallest_effect_that_a_file_may_set():
    assert set(SMALLEST) == set(UNITS)
    assert min(SMALLEST.values()) > 0
    assert parse_sweep("s", {"arms": ARMS}).smallest == SMALLEST
    mine = parse_sweep("s", {"arms": ARMS, "smallest": {"MPJPE": 0.4}}).smallest
    assert mine == {**SMALLEST, "MPJPE": 0.4}


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "the file: nothing; allowed is a mapping"),
        ({"arms": ARMS, "sedes": [0]}, "sedes: no such key; did you mean seeds?"),
        ({"arms": {}}, "arms: none to run"),
        ({"arms": {"a": {"overrides": None}}}, "arms: none to run"),
        ({"arms": {"a": {"overides": []}}}, "arms.a.overides: no such key; did you mean overrides?"),
        ({"arms": {"a": "memory=none"}}, "arms.a: 'memory=none'; allowed is a mapping"),
        ({"arms": {"a": ["memory none"]}}, "arms.a: 'memory none'; allowed is KEY=VALUE"),
        ({"arms": {"a": ["seed=1"]}}, "the seeds are set by the key seeds"),
        ({"arms": {"a": ["++seed=1"]}}, "the seeds are set by the key seeds"),
        ({"arms": {"a\nb": []}}, "allowed is a label of one line"),
        ({"arms": ARMS, "metrics": []}, "metrics: empty; allowed is at least one"),
        ({"arms": {"a": {"branch": "hips"}}}, "arms.a.branch: 'hips'; allowed are rotation"),
        ({"arms": {"a": {"branch": ["rotation"]}}}, "arms.a.branch: '['rotation']'; allowed are rotation"),
        ({"arms": ARMS, "branch": "hips"}, "branch: 'hips'; allowed are rotation, position, combined"),
        ({"arms": ARMS, "branch_source": 3}, "branch_source: 3; allowed is text"),
        ({"arms": ARMS, "smallest": {"MPJPE": 0}}, "smallest.MPJPE: 0; allowed is a number above 0"),
        ({"arms": ARMS, "smallest": {"MPJPE": True}}, "smallest.MPJPE: True; allowed is a number above 0"),
        ({"arms": ARMS, "smallest": {"MPJPE": ".1"}}, "smallest.MPJPE: '.1'; allowed is a number above 0"),
        ({"arms": ARMS, "smallest": {"Jitter": float("inf")}}, "smallest.Jitter: inf"),
        ({"arms": ARMS, "smallest": {"FLOPs": 1}}, "smallest.FLOPs: no such key"),
        ({"arms": ARMS, "smallest": 1}, "smallest: 1; allowed is a mapping"),
        ({"arms": {"a": {"against": "b"}, "c": []}}, "arms.a.against: 'b' is no other arm; allowed are c"),
        ({"arms": {"a": {"against": "a"}, "c": []}}, "arms.a.against: 'a' is no other arm; allowed are c"),
        ({"arms": {"a": {"against": "b"}, "b": {"overrides": None}}}, "arms.a.against: 'b' is no other arm"),
        ({"arms": {"a": {"paper": {"MPJPX": 1}}}}, "arms.a.paper.MPJPX: no such key"),
        ({"arms": {"a": {"paper": {"MPJPE": "3"}}}}, "arms.a.paper.MPJPE: '3'; allowed is a number"),
        ({"arms": ARMS, "seeds": [0, 0]}, "seeds: [0, 0]; allowed is a list of whole numbers, each once"),
        ({"arms": ARMS, "seeds": [-1]}, "seeds: [-1]"),
        ({"arms": ARMS, "control": "half"}, "control: 'half' is no arm; allowed are full, none"),
        ({"arms": ARMS, "metrics": ["FID"]}, "metrics: 'FID'; allowed are MPJRE"),
        ({"arms": ARMS, "table": "four"}, "table: 'four'"),
        ({"arms": ARMS, "axes": {"model.frames": 11}}, "axes.model.frames: allowed is a list of values"),
        ({"arms": {1: [], "1": []}}, "arms: two have the same label"),
        ({"arms": ARMS, "title": 5}, "title: 5; allowed is text"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, content, words: str):
    with pytest.raises(InputError) as error:
        parse_sweep("s", content)
    assert words in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("text", [b"arms: [", b"\xff\xfe", b"a: b: c", b"arms: {a: [], a: [memory=none]}"])
def test_a_file_that_is_no_yaml_is_named(tmp_path: Path, text: bytes):
    path = tmp_path / "mine.yaml"
    path.write_bytes(text)
    with pytest.raises(InputError, match=r"mine\.yaml"):
        load_sweep(path)
    with pytest.raises(InputError, match=r"absent\.yaml"):
        load_sweep(tmp_path / "absent.yaml")


KEYS = st.sampled_from([*spec.KEYS, "x"])
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)


@settings(max_examples=300)
@given(st.dictionaries(KEYS, VALUES, max_size=6))
def test_whatever_stands_in_it_is_a_sweep_or_one_line(content):
    try:
        said = str(len(parse_sweep("s", content).arm_seeds()))
    except InputError as error:
        said = str(error)
    assert said not in ("", "0")
