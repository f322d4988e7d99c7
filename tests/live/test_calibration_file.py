"""Calibrations as files: written and read again, and what else may lie there."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from memmlp.common.errors import InputError
from memmlp.live.calibration_file import Calibration, read_calibration, save_calibration
from memmlp.live.stream import Offsets

TURNS = np.stack([np.eye(3), np.eye(3)[[1, 2, 0]], np.diag([1.0, -1, -1])])
WORDS = {"memmlp": "calibration", "space": "unity", "body": 1.72, "height": 1.8, "floor": 0}
WORN = Calibration("unity", 1.72, Offsets(np.arange(9.0).reshape(3, 3) / 7, TURNS), 1.815, -0.02)


@pytest.mark.parametrize("made", [WORN, Calibration("openxr", 1.72)])
def test_there_and_back(made: Calibration, tmp_path: Path):
    save_calibration(tmp_path / "me.json", made)
    again = read_calibration(tmp_path / "me.json", made.space, 1.72)
    assert (again.space, again.height, again.floor) == (made.space, made.height, made.floor)
    assert (again.offsets is None) == (made.offsets is None)
    if again.offsets and made.offsets:
        for part, before in zip(again.offsets, made.offsets, strict=True):
            np.testing.assert_array_equal(part, before)


def test_offsets_of_another_frame_of_reference_are_refused(tmp_path: Path):
    """They would be taken for offsets along other axes, in silence."""
    save_calibration(tmp_path / "me.json", WORN)
    with pytest.raises(InputError, match=r"me\.json: of --space unity; allowed with it is that, not openxr"):
        read_calibration(tmp_path / "me.json", "openxr", 1.72)


def test_offsets_of_a_network_with_another_body_are_refused(tmp_path: Path):
    save_calibration(tmp_path / "me.json", WORN)
    with pytest.raises(InputError, match=r"me\.json: .* body of 1\.72 m, and this one's has 1\.68 m"):
        read_calibration(tmp_path / "me.json", "unity", 1.68)


@pytest.mark.parametrize(
    "content",
    [
        "", "[]", "{}", "[" * 5000, '{"memmlp": "calibration", "space": "unity"}', '{"memmlp": "calibr',
        json.dumps(WORDS), json.dumps(WORDS | {"offsets": {}}), json.dumps(WORDS | {"offsets": 5}),
        json.dumps(WORDS | {"offsets": None, "body": "tall"}),
        json.dumps(WORDS | {"offsets": {"positions": [[0] * 3] * 3, "rotations": [[[1] * 3] * 3] * 3}}),
    ],
)  # fmt: skip
def test_what_is_no_calibration_is_refused(content: str, tmp_path: Path):
    (tmp_path / "me.json").write_text(content)
    with pytest.raises(
        InputError, match=r"me\.json: .*allowed is a file that memmlp live --calibration wrote"
    ):
        read_calibration(tmp_path / "me.json", "unity", 1.72)


def test_a_folder_that_is_not_there_is_one_line(tmp_path: Path):
    with pytest.raises(InputError, match="cannot be written"):
        save_calibration(tmp_path / "none" / "me.json", WORN)
