"""A sweep's copy in its folder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from memmlp.common.errors import InputError
from memmlp.sweep.definition import Scale
from memmlp.sweep.sweep_file import parse_sweep
from memmlp.sweep.sweep_json import NAME, keep_sweep, kept_sweep

CONTENT = {
    "title": "Mine",
    "notes": ["of two arms"],
    "base": ["data=synthetic"],
    "control": "none",
    "arms": {"none": ["memory=none"], "gru": ["memory=gru"]},
}


def test_what_is_read_is_what_was_kept(tmp_path: Path):
    sweep = parse_sweep("mine", CONTENT)
    changed = replace(
        sweep.with_overrides(["seed=4,5", "optim.lr=0.1"]),
        scale=Scale(("compute", "a.b"), ("profile=paper",)),
        arms=(*sweep.arms[1:], replace(sweep.arms[0], series="a", cell=("b=1", "c=2"))),
    )
    assert kept_sweep(tmp_path) is None
    for each in (sweep, changed):
        keep_sweep(each, tmp_path)
        assert kept_sweep(tmp_path) == each


def test_a_copy_of_an_earlier_version_has_the_names_of_today(tmp_path: Path):
    sweep = parse_sweep("mine", CONTENT | {"base": ["normalizer.z_scores=false"]})
    sweep = replace(sweep, scale=Scale(("compute",)), command_line=("loggers=none",))
    keep_sweep(sweep, tmp_path)
    text = (tmp_path / NAME).read_text()
    former = ("normalizer.z_scores", "frame.normalize"), ('"along"', '"against"'), ("loggers=", "tracking=")
    for now, then in former:
        assert now in text
        text = text.replace(now, then)
    (tmp_path / NAME).write_text(text)
    assert kept_sweep(tmp_path) == sweep


def test_a_key_of_an_earlier_version_is_of_the_loss_that_the_base_or_an_arm_chooses(tmp_path: Path):
    chosen = {"base": ["loss=kinematic", "loss.position_from_pelvis=1"]}
    sweep = replace(parse_sweep("mine", CONTENT | chosen), command_line=("loss.position_from_pelvis=3",))
    arm = replace(sweep.arms[0], overrides=("model=rpm", "loss=rpm", "loss.world_position=2"))
    keep_sweep(replace(sweep, arms=(arm,)), tmp_path)
    text = (tmp_path / NAME).read_text()
    former = text.replace("position_from_pelvis", "position").replace("world_position", "position")
    (tmp_path / NAME).write_text(former)
    read = kept_sweep(tmp_path)
    assert (read.base, read.arms[0].overrides) == (sweep.base, arm.overrides)
    (tmp_path / NAME).write_text(former.replace("loss=kinematic", "optim.lr=1"))  # then the arm's
    assert kept_sweep(tmp_path).command_line == ("loss.world_position=3",)


def test_a_copy_of_the_same_content_is_not_written_again(tmp_path: Path):
    keep_sweep(parse_sweep("mine", CONTENT), tmp_path)
    before = (tmp_path / NAME).stat().st_mtime_ns
    keep_sweep(parse_sweep("mine", CONTENT), tmp_path)
    assert (tmp_path / NAME).stat().st_mtime_ns == before


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"arms": [{"no": 1}]}'])
def test_a_damaged_copy_is_named(tmp_path: Path, text: str):
    (tmp_path / NAME).write_text(text)
    with pytest.raises(InputError, match=f"{NAME}: not a sweep"):
        kept_sweep(tmp_path)
