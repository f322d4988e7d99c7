"""A sweep's copy in its folder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from memmlp.common.errors import InputError
from memmlp.sweep.sweep_file import parse_sweep
from memmlp.sweep.sweep_json import NAME, keep_sweep, kept_sweep

CONTENT = {
    "title": "Mine",
    "notes": ["of two variants"],
    "base": ["data=synthetic"],
    "control": "none",
    "variants": {"none": ["memory=none"], "gru": ["memory=gru"]},
}


def test_what_is_read_is_what_was_kept(tmp_path: Path):
    sweep = parse_sweep("mine", CONTENT)
    changed = replace(
        sweep.with_overrides(["seed=4,5", "optim.lr=0.1"]),
        variants=(*sweep.variants[1:], replace(sweep.variants[0], series="a", cell=("b=1", "c=2"))),
    )
    assert kept_sweep(tmp_path) is None
    for each in (sweep, changed):
        keep_sweep(each, tmp_path)
        assert kept_sweep(tmp_path) == each


def test_a_copy_of_the_same_content_is_not_written_again(tmp_path: Path):
    keep_sweep(parse_sweep("mine", CONTENT), tmp_path)
    before = (tmp_path / NAME).stat().st_mtime_ns
    keep_sweep(parse_sweep("mine", CONTENT), tmp_path)
    assert (tmp_path / NAME).stat().st_mtime_ns == before


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"variants": [{"no": 1}]}'])
def test_a_damaged_copy_is_named(tmp_path: Path, text: str):
    (tmp_path / NAME).write_text(text)
    with pytest.raises(InputError, match=f"{NAME}: not a sweep"):
        kept_sweep(tmp_path)
