"""Calibrations as files: written and read again, and what else may lie there."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from memmlp.common.errors import InputError
from memmlp.live.calibration_file import Calibration, read_calibration, save_calibration
from memmlp.live.rotations import BodyTree
from memmlp.live.stream import Offsets
from memmlp.motion.body import JOINTS, PARENTS, builtin_rest_joints

REST = builtin_rest_joints()
BODY = BodyTree(JOINTS, PARENTS, REST)
TURNS = np.stack([np.eye(3), np.eye(3)[[1, 2, 0]], np.diag([1.0, -1, -1])])
WORDS = {"memmlp": "calibration", "space": "unity", "body": 1.72, "height": 1.8, "floor": 0}
WORN = Calibration("unity", Offsets(np.arange(9.0).reshape(3, 3) / 7, TURNS), 1.815, -0.02)


@pytest.mark.parametrize("made", [WORN, Calibration("openxr")])
def test_there_and_back(made: Calibration, tmp_path: Path):
    save_calibration(tmp_path / "me.json", made, BODY)
    again = read_calibration(tmp_path / "me.json", made.space, BODY)
    assert (again.space, again.height, again.floor) == (made.space, made.height, made.floor)
    assert (again.offsets is None) == (made.offsets is None)
    if again.offsets and made.offsets:
        for part, before in zip(again.offsets, made.offsets, strict=True):
            np.testing.assert_array_equal(part, before)


def test_offsets_of_another_frame_of_reference_are_refused(tmp_path: Path):
    """They would be taken for offsets along other axes, in silence."""
    save_calibration(tmp_path / "me.json", WORN, BODY)
    with pytest.raises(InputError, match=r"me\.json: of --space unity; allowed with it is that, not openxr"):
        read_calibration(tmp_path / "me.json", "openxr", BODY)


def wider(by: float) -> np.ndarray:
    """Return a body of the same height whose left wrist is `by` metres further out."""
    rest = REST.copy()
    rest[JOINTS.index("left_wrist"), 0] += by
    return rest


@pytest.mark.parametrize(
    ("rest", "said"),
    [
        (REST * 1.68 / 1.72, r"body of 1\.72 m, and this one's has 1\.68 m"),
        (wider(0.03), r"its head or wrists 2\.0 cm elsewhere"),
        (wider(-0.03), r"its head or wrists 2\.0 cm elsewhere"),
    ],
)
def test_offsets_of_a_network_with_another_body_are_refused(rest: np.ndarray, said: str, tmp_path: Path):
    """They would hold the hands elsewhere, in silence."""
    save_calibration(tmp_path / "me.json", WORN, BODY)
    with pytest.raises(InputError, match=rf"me\.json: .* {said}"):
        read_calibration(tmp_path / "me.json", "unity", BodyTree(JOINTS, PARENTS, rest))


def test_rounding_is_no_other_body(tmp_path: Path):
    save_calibration(tmp_path / "me.json", WORN, BODY)
    near = BodyTree(JOINTS, PARENTS, wider(0.003))
    assert read_calibration(tmp_path / "me.json", "unity", near).height == 1.815


def test_a_file_of_before_joints_were_kept_is_read(tmp_path: Path):
    (tmp_path / "me.json").write_text(json.dumps(WORDS | {"offsets": None}))
    assert read_calibration(tmp_path / "me.json", "unity", BODY).height == 1.8


@pytest.mark.parametrize(
    "content",
    [
        "", "[]", "{}", "[" * 5000, '{"memmlp": "calibration", "space": "unity"}', '{"memmlp": "calibr',
        json.dumps(WORDS), json.dumps(WORDS | {"offsets": {}}), json.dumps(WORDS | {"offsets": 5}),
        json.dumps(WORDS | {"offsets": None, "body": "tall"}),
        json.dumps(WORDS | {"offsets": None, "joints": [1, 2]}),
        json.dumps(WORDS | {"offsets": None, "joints": [[float("nan")] * 3] * 3}),
        json.dumps(WORDS | {"offsets": {"positions": [[0] * 3] * 3, "rotations": [[[1] * 3] * 3] * 3}}),
    ],
)  # fmt: skip
def test_what_is_no_calibration_is_refused(content: str, tmp_path: Path):
    (tmp_path / "me.json").write_text(content)
    with pytest.raises(
        InputError, match=r"me\.json: .*allowed is a file that memmlp live --calibration wrote"
    ):
        read_calibration(tmp_path / "me.json", "unity", BODY)


def test_a_folder_that_is_not_there_is_one_line(tmp_path: Path):
    with pytest.raises(InputError, match="cannot be written"):
        save_calibration(tmp_path / "none" / "me.json", WORN, BODY)
