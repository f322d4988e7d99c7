"""The picture of a skeleton's map: names that do not overlap, sides in their colours, the body beside it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bvh_samples import write
from PIL import Image
from skeleton_families import family, walking

from memmlp.motion.body import builtin_rest_joints
from memmlp.motion.formats.bvh import read_bvh
from memmlp.motion.importing.convert import view_stance
from memmlp.motion.importing.skeleton_map import find_skeleton
from memmlp.report.pictures.skeleton_picture import (
    HEIGHT,
    LEFT,
    MIDDLE,
    RIGHT,
    WIDTH,
    spread,
    write_skeleton_picture,
)


@pytest.mark.parametrize(
    ("wanted", "places"),
    [
        ([100.0, 105.0], [100.0, 120.0]),
        ([0.0, 195.0, 199.0], [0.0, 180.0, 200.0]),
        ([-50.0, 500.0], [0.0, 200.0]),
    ],
)
def test_names_keep_their_distance(wanted: list[float], places: list[float]):
    assert spread(wanted, 20, 0, 200) == places
    assert np.allclose(spread([100.0] * 21, 20, 0, 200), np.arange(21) * 10)


def pixels(picture: np.ndarray, colour: str) -> np.ndarray:
    """Return the columns of the pixels of just that colour."""
    rgb = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
    return np.nonzero((picture == rgb).all(-1))[1]


def draw(folder: Path, name: str, far: bool = False) -> np.ndarray:
    bvh = read_bvh(write(folder, walking(name).text()))
    stance = view_stance(bvh, find_skeleton(bvh), builtin_rest_joints())
    if far:
        stance.positions[stance.nodes.index("HeadTop_End")] += [5.0, 0.0, 5.0]
    write_skeleton_picture(folder / "out.png", stance, "a file")
    return np.asarray(Image.open(folder / "out.png"))


@pytest.mark.slow
def test_sides_are_on_their_sides(tmp_path: Path):
    picture = draw(tmp_path, "mixamo")
    assert picture.shape == (HEIGHT, WIDTH, 3)
    front = picture[100:-60, 250:730]
    right, left, middle = (np.median(pixels(front, colour)) for colour in (RIGHT, LEFT, MIDDLE))
    assert right < middle < left
    body = picture[100:-60, -700:]
    assert (body.max(-1) < 200).mean() > 0.05


@pytest.mark.slow
def test_nodes_far_away_are_left_out(tmp_path: Path):
    assert len(family("mixamo").names) > 22
    near, far = (draw(tmp_path, "mixamo", far) for far in (False, True))
    names = slice(980 + 80, 1210)
    assert np.array_equal(near[100:-60, names], far[100:-60, names])
    assert not np.array_equal(near, far)
