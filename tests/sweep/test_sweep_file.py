"""Sweep files: what may stand in them, and how a fault is named."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from memmlp.common.errors import InputError
from memmlp.evaluation.metric_facts import SMALLEST, UNITS
from memmlp.sweep import sweep_file
from memmlp.sweep.sweep_file import load_sweep, parse_sweep

SCALED = {
    "arms": {"full": [], "none": {"overrides": ["memory=none"], "against": "full"}},
    "axes": [{"a": [1, 2], "b": [3]}, {"a": [None]}],
}
ARMS = {"full": [], "none": {"overrides": ["memory=none"], "paper": {"MPJPE": 4.13}}}


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
        ({"arms": {"a": {"against": "b"}, "c": []}}, "arms.a.against: 'b' is no other arm; allowed are 'c'"),
        ({"arms": {"a": {"against": "a"}, "c": []}}, "arms.a.against: 'a' is no other arm; allowed are 'c'"),
        ({"arms": {"a": {"against": "b"}, "b": {"overrides": None}}}, "arms.a.against: 'b' is no other arm"),
        ({"arms": {"a": {"paper": {"MPJPX": 1}}}}, "arms.a.paper.MPJPX: no such key"),
        ({"arms": {"a": {"paper": {"MPJPE": "3"}}}}, "arms.a.paper.MPJPE: '3'; allowed is a number"),
        ({"arms": ARMS, "seeds": [0, 0]}, "seeds: [0, 0]; allowed is a list of whole numbers, each once"),
        ({"arms": ARMS, "seeds": [-1]}, "seeds: [-1]"),
        (
            {"arms": ARMS, "seeds": 3},
            "seeds: 3; allowed is a list of whole numbers, each once, such as [0, 1, 2]",
        ),
        ({"arms": ARMS, "control": "half"}, "control: 'half' is no arm; allowed are 'full', 'none'"),
        ({"arms": ARMS, "metrics": ["FID"]}, "metrics: 'FID'; allowed are MPJRE"),
        ({"arms": ARMS, "table": "four"}, "table: 'four'"),
        ({"arms": ARMS, "axes": {"model.frames": 11}}, "axes.model.frames: allowed is a list of values"),
        ({"arms": ARMS, "axes": []}, "axes: an empty list; allowed is a mapping"),
        ({"arms": ARMS, "axes": 3}, "axes: 3; allowed is a mapping"),
        ({"arms": ARMS, "axes": [{"model.width": [8]}, 3]}, "axes[1]: 3; allowed is a mapping"),
        ({"arms": ARMS, "axes": [{"model.width": [8]}, {}]}, "axes[1]: empty; allowed is a mapping"),
        ({"arms": ARMS, "axes": [{"model.width": 8}]}, "axes[0].model.width: allowed is a list of values"),
        ({"arms": ARMS, "axes": [{"a": [1]}, {"seed": [0]}]}, "axes[1].seed: allowed in a single grid"),
        ({"arms": ARMS, "scale": {}}, "scale: allowed with axes, and arms that name their control"),
        ({"arms": ARMS, "axes": {"a": [1]}, "scale": {}}, "scale: allowed with axes, and arms that name"),
        ({**SCALED, "scale": {"alnog": []}}, "scale.alnog: no such key; did you mean along?"),
        ({**SCALED, "scale": {"along": []}}, "scale.along: allowed is a list of at least one"),
        ({**SCALED, "scale": {"along": ["a", "a"]}}, "scale.along: allowed is a list of at least one"),
        ({**SCALED, "scale": {"along": ["c"]}}, "scale.along: 'c' is no axis; allowed are compute, a, b"),
        ({**SCALED, "scale": {"along": ["b"]}}, "scale.along: axes[1] has no b"),
        ({**SCALED, "scale": {"along": ["a"]}}, "scale.along: a=null; allowed are numbers above 0"),
        ({**SCALED, "scale": {"predict": ["pro file"]}}, "scale.predict: 'pro file'; allowed is KEY=VALUE"),
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


KEYS = st.sampled_from([*sweep_file.KEYS, "x"])
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)


@pytest.mark.slow
@settings(max_examples=300)
@given(st.dictionaries(KEYS, VALUES, max_size=6))
def test_whatever_stands_in_it_is_a_sweep_or_one_line(content):
    try:
        said = str(len(parse_sweep("s", content).arm_seeds()))
    except InputError as error:
        said = str(error)
    assert said not in ("", "0")
