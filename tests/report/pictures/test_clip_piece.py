"""The camera of a clip's piece."""

from __future__ import annotations

import numpy as np
import pytest
import tiny

from memmlp.common.errors import InputError
from memmlp.evaluation.modes import joint_positions
from memmlp.motion.body import SPARSE_DIM
from memmlp.report.pictures.clip_piece import ClipPiece, frame_range
from memmlp.report.pictures.raster import draw

TRUTH = joint_positions(tiny.clip(31)[:, SPARSE_DIM:]).numpy().astype(np.float64)


def test_a_piece_without_frames_is_rejected():
    assert frame_range(120, "walk", 0.5, None) == (30, 120)
    assert frame_range(120, "walk", 0.0, 9.0) == (0, 120)
    for begin, end in ((2.0, None), (1.0, 1.0), (float("nan"), None)):
        with pytest.raises(InputError, match="begin"):
            frame_range(120, "walk", begin, end)


def test_the_camera_goes_along():
    moving = ClipPiece("walk", TRUTH + np.linspace(0, 4, 31)[:, None, None] * [1, 0, 0], {"a": TRUTH})
    apart = moving.path() - moving.truth[:, 0, :2]
    assert np.abs(apart[10:21]).max() < 0.8
    assert np.ptp(moving.path()[:, 0]) > 1.5


def test_a_hand_above_the_head_is_in_the_picture():
    raised = TRUTH.copy()
    raised[:, 20] = raised[:, 15] + [0.1, 0.1, 0.6]  # the left wrist, and the head
    away = np.full_like(TRUTH, np.nan)  # of a network that diverged
    tall = ClipPiece("clips/one", raised, {"bad": away})
    for frame in (0, 30):
        camera = tall.camera(tall.azimuth(frame), raised[frame, 0, :2], 230, 330)
        edge = 330 / 2 / camera.scale
        assert np.abs(camera.project(raised[frame])[:, 1]).max() < edge
    picture = draw(camera, raised[30], None, tall.floor)
    assert (picture[0] == 255).all()
    assert ClipPiece("clips/one", TRUTH, {}).metres < tall.metres < 2.9
