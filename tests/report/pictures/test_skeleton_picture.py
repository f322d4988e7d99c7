"""The picture of a skeleton map: sides in their colours, the body beside it."""

from pathlib import Path

import numpy as np
import pytest
from bvh_samples import write
from PIL import Image
from skeleton_families import walking

from memmlp.motion.body import make_builtin_rest_joints
from memmlp.motion.formats.bvh import read_bvh
from memmlp.motion.importing.convert import view_stance
from memmlp.motion.importing.skeleton_map import find_skeleton
from memmlp.report.pictures.skeleton_picture import LEFT, MIDDLE, RIGHT, write_skeleton_picture


@pytest.mark.slow
@pytest.mark.parametrize("far", [False, True])
def test_sides_are_on_their_sides(tmp_path: Path, far: bool):
    bvh = read_bvh(write(tmp_path, walking("mixamo").text()))
    stance = view_stance(bvh, find_skeleton(bvh), make_builtin_rest_joints())
    if far:
        stance.positions[stance.nodes.index("HeadTop_End")] += [50.0, 0.0, 50.0]
    write_skeleton_picture(tmp_path / "out.png", stance, "a file")
    picture = np.asarray(Image.open(tmp_path / "out.png").convert("RGB"))
    width = picture.shape[1] // 5
    front, body = picture[:, width : 2 * width], picture[60:-60, 3 * width :]
    colours = [[int(colour[i : i + 2], 16) for i in (1, 3, 5)] for colour in (RIGHT, LEFT, MIDDLE)]
    right, left, middle = (np.median(np.nonzero((front == rgb).all(-1))[1]) for rgb in colours)
    assert right + 5 < middle < left - 5
    assert 0.05 < (body.max(-1) < 200).mean() < 0.5
