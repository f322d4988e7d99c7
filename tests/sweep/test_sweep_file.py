"""Sweep files: what may stand in them, and how a fault is named."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from memmlp.common.errors import InputError
from memmlp.evaluation.metric_facts import SMALLEST, UNITS
from memmlp.sweep import sweep_file
from memmlp.sweep.sweep_file import load_sweep, parse_sweep

VARIANTS = {"full": [], "none": {"overrides": ["memory=none"], "paper": {"MPJPE": 4.13}}}


def test_every_metric_has_a_smallest_effect_that_a_file_may_set():
    assert set(SMALLEST) == set(UNITS)
    assert min(SMALLEST.values()) > 0
    assert parse_sweep("s", {"variants": VARIANTS}).smallest == SMALLEST
    mine = parse_sweep("s", {"variants": VARIANTS, "smallest": {"MPJPE": 0.4}}).smallest
    assert mine == {**SMALLEST, "MPJPE": 0.4}


WRONG: list[tuple[object, str]] = [
    (None, "the file: nothing"),
    ({"variants": VARIANTS, "sedes": [0]}, "sedes: no such key; did you mean seeds?"),
    ({"variants": {}}, "variants: "),
    ({"variants": {"a": {"overrides": None}}}, "variants: "),
    ({"variants": {"a": {"overides": []}}}, "variants.a.overides: no such key; did you mean overrides?"),
    ({"variants": {"a": "memory=none"}}, "variants.a: 'memory=none'"),
    ({"variants": {"a": ["memory none"]}}, "variants.a: 'memory none'"),
    ({"variants": {"a": ["seed=1"]}}, "expected the key seeds for seeds"),
    ({"variants": {"a": ["++seed=1"]}}, "expected the key seeds for seeds"),
    ({"variants": {"a\nb": []}}, "a label in one line"),
    ({"variants": {1: [], "1": []}}, "variants: two variants have the same label"),
    ({"variants": {"a": {"branch": "hips"}}}, "variants.a.branch: 'hips'"),
    ({"variants": {"a": {"branch": ["rotation"]}}}, "variants.a.branch: '['rotation']'"),
    ({"variants": {"a": {"against": "b"}, "c": []}}, "variants.a.against: 'b'"),
    ({"variants": {"a": {"against": "a"}, "c": []}}, "variants.a.against: 'a'"),
    ({"variants": {"a": {"against": "b"}, "b": {"overrides": None}}}, "variants.a.against: 'b'"),
    ({"variants": {"a": {"paper": {"MPJPX": 1}}}}, "variants.a.paper.MPJPX: no such key"),
    ({"variants": {"a": {"paper": {"MPJPE": "3"}}}}, "variants.a.paper.MPJPE: '3'"),
    ({"variants": VARIANTS, "metrics": []}, "metrics: "),
    ({"variants": VARIANTS, "metrics": ["FID"]}, "metrics: ['FID']"),
    ({"variants": VARIANTS, "branch": "hips"}, "branch: 'hips'"),
    ({"variants": VARIANTS, "branch_source": 3}, "branch_source: 3"),
    ({"variants": VARIANTS, "smallest": {"MPJPE": 0}}, "smallest.MPJPE: 0"),
    ({"variants": VARIANTS, "smallest": {"MPJPE": True}}, "smallest.MPJPE: True"),
    ({"variants": VARIANTS, "smallest": {"Jitter": float("inf")}}, "smallest.Jitter: inf"),
    ({"variants": VARIANTS, "smallest": {"FLOPs": 1}}, "smallest.FLOPs: no such key"),
    ({"variants": VARIANTS, "smallest": 1}, "smallest: 1"),
    ({"variants": VARIANTS, "seeds": [0, 0]}, "seeds: [0, 0]"),
    ({"variants": VARIANTS, "seeds": [-1]}, "seeds: [-1]"),
    ({"variants": VARIANTS, "seeds": 3}, "seeds: 3"),
    ({"variants": VARIANTS, "control": "half"}, "control: 'half'"),
    ({"variants": VARIANTS, "table": "four"}, "table: 'four'"),
    ({"variants": VARIANTS, "table": 0}, "table: 0"),
    ({"variants": VARIANTS, "title": 5}, "title: 5"),
    ({"variants": VARIANTS, "axes": {"model.frames": 11}}, "axes.model.frames: "),
    ({"variants": VARIANTS, "axes": []}, "axes: empty"),
    ({"variants": VARIANTS, "axes": 3}, "axes: 3"),
    ({"variants": VARIANTS, "axes": [{"model.width": [8]}, 3]}, "axes[1]: 3"),
    ({"variants": VARIANTS, "axes": [{"model.width": [8]}, {}]}, "axes[1]: empty"),
    ({"variants": VARIANTS, "axes": [{"model.width": 8}]}, "axes[0].model.width: "),
    ({"variants": VARIANTS, "axes": [{"a": [1]}, {"seed": [0]}]}, "axes[1].seed: "),
    (
        {"variants": {"slow": ["optim.lr=1"], "b": []}, "axes": {"optim.lr": [2]}},
        "variant 'slow': sets optim.lr",
    ),
]


def test_what_is_wrong_is_named():
    for content, words in WRONG:
        with pytest.raises(InputError) as error:
            parse_sweep("s", content)
        assert words in str(error.value), content
        assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "text", [b"variants: [", b"\xff\xfe", b"a: b: c", b"variants: {a: [], a: [memory=none]}"]
)
def test_a_file_that_is_no_yaml_is_named(tmp_path: Path, text: bytes):
    (tmp_path / "mine.yaml").write_bytes(text)
    for name in ("mine", "absent"):
        with pytest.raises(InputError, match=rf"{name}\.yaml"):
            load_sweep(tmp_path / f"{name}.yaml")


KEYS = st.sampled_from([*sweep_file.KEYS, "x"])
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)


@pytest.mark.slow
@settings(max_examples=60)
@given(st.dictionaries(KEYS, VALUES, max_size=6))
def test_whatever_stands_in_it_is_a_sweep_or_one_line(content):
    try:
        said = str(len(parse_sweep("s", content).list_variant_seeds()))
    except InputError as error:
        said = str(error)
    assert said not in ("", "0")
