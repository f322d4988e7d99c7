"""Sweep files: what may stand in them, and how a fault is named."""

from pathlib import Path

import pytest

from memmlp.common.errors import InputError
from memmlp.evaluation.metric_facts import SMALLEST, UNITS
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
    ({"variants": {"a": ["memory none"]}}, "variants.a: 'memory none'"),
    ({"variants": {"a": ["seed=1"]}}, "expected the key seeds for seeds"),
    ({"variants": {"a\nb": []}}, "a label in one line"),
    ({"variants": {"a": {"branch": "hips"}}}, "variants.a.branch: 'hips'"),
    ({"variants": {"a": {"against": "b"}, "c": []}}, "variants.a.against: 'b'"),
    ({"variants": {"a": {"paper": {"MPJPX": 1}}}}, "variants.a.paper.MPJPX: no such key"),
    ({"variants": VARIANTS, "metrics": ["FID"]}, "metrics: ['FID']"),
    ({"variants": VARIANTS, "smallest": {"MPJPE": 0}}, "smallest.MPJPE: 0"),
    ({"variants": VARIANTS, "control": "half"}, "control: 'half'"),
    ({"variants": VARIANTS, "table": "four"}, "table: 'four'"),
    ({"variants": VARIANTS, "axes": {"model.frames": 11}}, "axes.model.frames: "),
    ({"variants": VARIANTS, "axes": [{"model.width": [8]}, 3]}, "axes[1]: 3"),
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
