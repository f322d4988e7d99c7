"""Units and up axes: told, found, or refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bvh_samples import own_tree, performed, random_turns, read, refuse, write
from scipy.spatial.transform import Rotation

from memmlp.motion.clip import Clip
from memmlp.motion.formats.bvh import Bvh, read_bvh
from memmlp.motion.importing.axes import UNITS, with_unit_and_up
from memmlp.motion.importing.skeleton_map import SkeletonMap, load_skeleton
from memmlp.motion.synthetic import synthesize_clip

TOLD = replace(load_skeleton("cmu_daz"), calibration_frame=False)
FOUND = replace(TOLD, unit=None, up=None)


@pytest.fixture(scope="module")
def walk() -> Clip:
    return synthesize_clip("walking", 1, seconds=1.0)


def file(folder: Path, chosen: SkeletonMap, clip: Clip, turned: bool = True) -> Bvh:
    turns = random_turns(own_tree(chosen), 1) if turned else None
    return read_bvh(write(folder, performed(chosen, clip, turns=turns).text()))


@pytest.mark.parametrize("up", ["y", "z"])
@pytest.mark.parametrize("unit", UNITS)
def test_unit_and_up_are_found(tmp_path: Path, walk: Clip, unit: float, up: str) -> None:
    settled = with_unit_and_up(file(tmp_path, replace(TOLD, unit=unit, up=up), walk), FOUND)
    assert (settled.unit, settled.up) == (unit, up)


def test_what_is_told_counts(tmp_path: Path, walk: Clip) -> None:
    assert with_unit_and_up(file(tmp_path, TOLD, walk), replace(TOLD, up="z", unit=0.012)).up == "z"
    assert with_unit_and_up(file(tmp_path, TOLD, walk), replace(TOLD, up="z", unit=0.012)).unit == 0.012


@pytest.mark.parametrize("unit", [0.3048, 10.0, 1e-4])
def test_an_unknown_unit_is_refused(tmp_path: Path, walk: Clip, unit: float) -> None:
    with refuse(tmp_path / "clip.bvh", "legs of", "fits none of"):
        with_unit_and_up(file(tmp_path, replace(TOLD, unit=unit), walk), FOUND)


@pytest.mark.parametrize("unit", [1.0, 0.1, 0.0254, 0.001])
def test_a_wrong_unit_is_refused(tmp_path: Path, walk: Clip, unit: float) -> None:
    with refuse(tmp_path / "clip.bvh", f"with the unit {unit:g} of cmu_daz"):
        with_unit_and_up(file(tmp_path, TOLD, walk), replace(TOLD, unit=unit))


@pytest.mark.parametrize("axis", ["x", "-y"])
def test_another_up_axis_is_refused(tmp_path: Path, walk: Clip, axis: str) -> None:
    turn = {"x": [0.0, np.pi / 2, 0.0], "-y": [np.pi, 0.0, 0.0]}[axis]
    poses = walk.poses.astype(float)
    poses[:, 0] = (Rotation.from_rotvec(turn) * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    with refuse(tmp_path / "clip.bvh", "no up axis is found"):
        with_unit_and_up(file(tmp_path, TOLD, replace(walk, poses=poses)), FOUND)


def test_the_calibration_frame_does_not_count(tmp_path: Path) -> None:
    bvh = read(tmp_path, "cmu_daz", frames=1)
    assert with_unit_and_up(bvh, replace(FOUND, calibration_frame=True)).up is None


def lying(clip: Clip, head: str) -> Clip:
    """Turn a clip's person down to lie with the head along an axis of Y-up axes."""
    turn = {"z": [np.pi / 2, 0.0, 0.0], "x": [0.0, np.pi / 2, 0.0], "-z": [-np.pi / 2, 0.0, 0.0]}[head]
    poses, trans = clip.poses.astype(float), np.zeros(clip.trans.shape)
    poses[:, 0] = (Rotation.from_rotvec(turn) * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    return replace(clip, poses=poses, trans=trans)


@pytest.mark.parametrize(("up", "head"), [("y", "x"), ("y", "-z"), ("z", "x"), ("z", "z")])
def test_who_lies_in_a_file_whose_zero_pose_stands_lies(
    tmp_path: Path, walk: Clip, up: str, head: str
) -> None:
    chosen = replace(TOLD, up=up)
    assert with_unit_and_up(file(tmp_path, chosen, lying(walk, head), turned=False), FOUND).up == up


def test_a_zero_pose_and_a_motion_of_two_minds_are_refused(tmp_path: Path, walk: Clip) -> None:
    """It may be a person who lies, or one who walks while only the root's rotation has Z up."""
    bvh = file(tmp_path, TOLD, lying(walk, "z"), turned=False)
    with refuse(tmp_path / "clip.bvh", "stands along y in the zero pose", "along z in the motion", "--up y"):
        with_unit_and_up(bvh, FOUND)
    assert [with_unit_and_up(bvh, replace(FOUND, up=up)).up for up in "yz"] == ["y", "z"]
    upside_down = lying(lying(walk, "z"), "z")
    with refuse(tmp_path / "clip.bvh", "no up axis is found"):
        with_unit_and_up(file(tmp_path, TOLD, upside_down, turned=False), FOUND)
