"""Drawn skeletons: colours of errors and what is in front."""

from __future__ import annotations

import numpy as np
import pytest
import tiny

from memmlp.evaluation.modes import joint_positions
from memmlp.motion.body import SPARSE_DIM
from memmlp.report.pictures.clip_piece import ClipPiece
from memmlp.report.pictures.raster import Camera, colour_scale_top, draw

TRUTH = joint_positions(tiny.clip(31)[:, SPARSE_DIM:]).numpy().astype(np.float64)


@pytest.fixture
def camera() -> Camera:
    piece = ClipPiece("clip", TRUTH, {})
    return piece.camera(piece.azimuth(0), TRUTH[0, 0, :2], 120, 180)


def colour(picture: np.ndarray) -> np.ndarray:
    """Return the mean colour (3,) of all pixels that are not white or grey."""
    vivid = picture.max(-1).astype(int) - picture.min(-1) > 60
    return picture[vivid].mean(0)


def test_errors_colour_the_body(camera: Camera):
    blue, red = (colour(draw(camera, TRUTH[0], np.full(22, part), 0.0)) for part in (0.0, 1.0))
    assert blue.argmax() == 2
    assert red.argmax() == 0


def test_one_joints_error_colours_its_limbs_alone(camera: Camera):
    errors = np.zeros(22)
    plain = draw(camera, TRUTH[0], errors, 0.0)
    errors[7] = 1.0  # the left ankle
    picture = draw(camera, TRUTH[0], errors, 0.0)
    changed = (picture != plain).any(-1)
    rows, columns = np.nonzero(changed)
    ankle = camera.project(TRUTH[0, 7]) * camera.scale
    assert 20 < changed.sum() < 0.1 * changed.size
    assert np.hypot(columns - 60 - ankle[0], 90 - rows - ankle[1]).max() < 0.55 * camera.scale
    x, y, _ = (camera.project(TRUTH[0, [7, 4]]) * camera.scale).T
    at_ankle, at_knee = picture[np.round(90 - y).astype(int), np.round(60 + x).astype(int)]
    assert at_ankle.argmax() == 0
    assert at_knee.argmax() == 2


def test_the_truth_has_no_colour(camera: Camera):
    picture = draw(camera, TRUTH[0], None, 0.0).astype(int)
    assert (picture.max(-1) - picture.min(-1)).max() < 40
    assert (picture < 150).any()


def test_the_nearer_body_part_is_seen(camera: Camera):
    """A hand before the chest is seen there in its own colour, a hand behind it is not."""
    seen = []
    for away in (0.35, -0.35):
        joints = TRUTH[0].copy()
        joints[20] = joints[9] + away * camera.axes[2]
        errors = np.zeros(22)
        errors[20] = 1.0
        x, y, _ = camera.project(joints[20]) * camera.scale
        seen.append(draw(camera, joints, errors, 0.0)[round(90 - y), round(60 + x)])
    assert seen[0].argmax() == 0
    assert seen[1].argmax() == 2


def test_the_scale_is_round_and_leaves_few_above():
    errors = np.random.default_rng(0).gamma(2, 4, 5000)
    assert colour_scale_top(errors) == 25 or colour_scale_top(errors) == 30
    assert (errors > colour_scale_top(errors)).mean() <= 0.02
    assert colour_scale_top(np.zeros(3)) == 10
    assert colour_scale_top(np.full(3, 1e6)) == 100
