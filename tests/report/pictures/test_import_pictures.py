"""Sheets of clips: which clips, how many panels, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bvh_samples import write
from PIL import Image
from skeleton_families import walking

from memmlp.common.errors import InputError
from memmlp.motion.body import make_builtin_rest_joints
from memmlp.motion.formats.bvh import read_bvh
from memmlp.motion.formats.npz import write_clip
from memmlp.motion.importing.convert import view_stance
from memmlp.motion.importing.skeleton_map import find_skeleton
from memmlp.motion.synthetic import synthesize_clip
from memmlp.report.pictures.import_pictures import LEFT, MIDDLE, RIGHT, read_sample, write_skeleton_picture


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    clip = synthesize_clip("walking", 1, seconds=0.5)
    for number in range(7):
        (tmp_path / "clips" / f"{number}").mkdir(parents=True)
        write_clip(tmp_path / "clips" / f"{number}" / "walk.npz", clip)
    return tmp_path / "clips"


@pytest.mark.parametrize(("count", "numbers"), [(1, [0]), (3, [0, 3, 6]), (99, range(7))])
def test_clips_are_evenly_spread(folder: Path, count: int, numbers: list[int]):
    clips, skipped, total = read_sample(folder, count)
    assert [name for name, _ in clips] == [f"{number}/walk" for number in numbers]
    assert (skipped, total) == ([], 7)
    assert clips[0][1].shape[1:] == (22, 3)
    assert read_sample(folder / "2" / "walk.npz", count)[0][0][0] == "walk"


def test_bad_files_are_named(folder: Path, tmp_path: Path):
    (folder / "0" / "walk.npz").write_bytes(b"no")
    clips, (skipped,), _ = read_sample(folder, 7)
    assert (len(clips), skipped.file, str(folder) in skipped.reason) == (6, "0/walk.npz", False)
    with pytest.raises(InputError, match=r"none of 1 files could be read.*0/walk\.npz"):
        read_sample(folder, 1)
    with pytest.raises(InputError, match="no such file"):
        read_sample(tmp_path / "none.npz", 1)


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
