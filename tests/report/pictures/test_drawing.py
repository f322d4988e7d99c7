"""Drawn skeletons: colours of errors, and the body part in front."""

import numpy as np
import pytest
import tiny

from memmlp.evaluation.modes import extract_positions
from memmlp.motion.body import SPARSE_DIM
from memmlp.report.pictures.clip_pictures import ClipPiece
from memmlp.report.pictures.drawing import Camera, draw_skeleton, freeze_layout, get_pixels, make_panels

TRUTH = extract_positions(tiny.clip(31)[:, SPARSE_DIM:]).numpy().astype(np.float64)
WIDTH, HEIGHT = 120, 180


@pytest.fixture
def camera() -> Camera:
    piece = ClipPiece("clip", TRUTH, {})
    return piece.make_camera(piece.find_azimuth(0), TRUTH[0, 0, :2])


def draw(camera: Camera, joints: np.ndarray, errors: np.ndarray | None) -> np.ndarray:
    figure, panels = make_panels(WIDTH, HEIGHT, 1, 1)
    freeze_layout(figure)
    panels[0, 0].set_position((0, 0, 1, 1))
    for _ in range(2):  # the second drawing takes the first one's place
        draw_skeleton(panels[0, 0], camera, joints, errors)
    return get_pixels(figure).astype(int)


def at(picture: np.ndarray, camera: Camera, point: np.ndarray) -> np.ndarray:
    right, up, _ = camera.project(point) * HEIGHT / camera.metres
    return picture[round(HEIGHT / 2 - up), round(WIDTH / 2 + right)]


def test_errors_colour_the_limbs_of_their_joints(camera: Camera):
    truth = draw(camera, TRUTH[0], None)
    assert (truth.max(-1) - truth.min(-1)).max() < 40
    assert (truth < 150).any()
    errors = np.zeros(22)
    plain = draw(camera, TRUTH[0], errors)
    errors[7] = 1.0  # the left ankle
    picture = draw(camera, TRUTH[0], errors)
    changed = (picture != plain).any(-1)
    assert 20 < changed.sum() < 0.1 * changed.size
    assert at(picture, camera, TRUTH[0, 7]).argmax() == 0
    assert at(picture, camera, TRUTH[0, 4]).argmax() == 2


def test_a_diverged_network_leaves_a_white_panel(camera: Camera):
    picture = draw(camera, np.full((22, 3), np.nan), np.full(22, np.nan))
    assert (picture > 100).all()
