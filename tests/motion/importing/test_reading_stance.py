"""The stance from which a skeleton is read, and what is refused by name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bvh_samples import own_tree, performed, random_turns, read, refuse, rest_turns, write
from scipy.spatial.transform import Rotation

from memmlp.motion.clip import Clip
from memmlp.motion.formats.bvh import read_bvh
from memmlp.motion.importing.mapped_motion import pick_joints
from memmlp.motion.importing.reading_stance import Stance, find_stance
from memmlp.motion.importing.skeleton_map import SkeletonMap, load_skeleton
from memmlp.motion.synthetic import synthesize_clip

DAZ = replace(load_skeleton("cmu_daz"), calibration_frame=False)
BANDAI = load_skeleton("bandai_namco")
ARM = ("collar", "shoulder", "elbow", "wrist")
LEG = ("hip", "knee", "ankle", "foot")


@pytest.fixture(scope="module")
def walk() -> Clip:
    return synthesize_clip("walking", 1, seconds=1.0)


def found(
    folder: Path, clip: Clip, chosen: SkeletonMap, written: SkeletonMap = DAZ, turns: np.ndarray | None = None
) -> Stance:
    """The stance of a file written by one map and read by another."""
    bvh = read_bvh(write(folder, performed(written, clip, turns=turns).text()))
    return find_stance(bvh, chosen, pick_joints(bvh, chosen))


def whole(turn: Rotation) -> np.ndarray:
    """A zero pose turned as a whole."""
    return np.tile(turn.as_matrix(), (len(own_tree(DAZ).names), 1, 1))


@pytest.mark.parametrize("degrees", [0, 90, 180, -37])
def test_a_zero_pose_that_stands_serves(tmp_path: Path, walk: Clip, degrees: float) -> None:
    """Whichever way it faces, it is turned to face +Z."""
    stance = found(tmp_path, walk, DAZ, turns=whole(Rotation.from_euler("y", degrees, degrees=True)))
    assert (stance.source, stance.straight) == ("the zero pose", True)
    left = stance.positions[1] - stance.positions[2]
    np.testing.assert_allclose(left / np.linalg.norm(left), [1, 0, 0], atol=1e-6)
    assert (stance.positions[10] - stance.positions[7])[2] > 0


@pytest.mark.parametrize("axis", ["x", "z"])
@pytest.mark.parametrize("degrees", [90, 180, -90])
def test_a_zero_pose_that_lies_does_not_serve(tmp_path: Path, walk: Clip, axis: str, degrees: float) -> None:
    stance = found(tmp_path, walk, DAZ, turns=whole(Rotation.from_euler(axis, degrees, degrees=True)))
    assert stance.source.endswith("the straightest")
    assert not stance.straight


def test_a_runner_whose_feet_point_back_is_no_stance(tmp_path: Path, walk: Clip) -> None:
    """The next straightest frame serves."""
    turns = random_turns(own_tree(DAZ), 1)
    first = found(tmp_path, walk, DAZ, turns=turns)
    bvh = read_bvh(tmp_path / "clip.bvh")
    mapped_motion = pick_joints(bvh, DAZ)
    frame = int(first.source.split()[1].rstrip(","))
    for ankle, toes in ((7, 10), (8, 11)):
        foot = mapped_motion.positions[frame, toes] - mapped_motion.positions[frame, ankle]
        mapped_motion.positions[frame, toes] -= 2 * foot * [1, 0, 1]
    other = find_stance(bvh, DAZ, mapped_motion)
    assert other.source.endswith("the straightest")
    assert other.source != first.source


def test_a_given_frame(tmp_path: Path, walk: Clip) -> None:
    stance = found(tmp_path, walk, replace(DAZ, rest=7))
    assert stance.source == "frame 7, given"
    with refuse(tmp_path / "clip.bvh", "no frame 60 for rest"):
        found(tmp_path, walk, replace(DAZ, rest=60))


def lying(clip: Clip) -> Clip:
    poses = clip.poses.astype(float)
    poses[:, 0] = (Rotation.from_rotvec([1.5, 0, 0]) * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    return replace(clip, poses=poses)


def test_who_never_stands_is_refused(tmp_path: Path, walk: Clip) -> None:
    turns = random_turns(own_tree(DAZ), 1)
    with refuse(tmp_path / "clip.bvh", "stands neither in the zero pose (", "nor in any frame (at best, "):
        found(tmp_path, lying(walk), DAZ, turns=turns)
    with refuse(tmp_path / "clip.bvh", "rest: frame 3: pelvis to head is"):
        found(tmp_path, lying(walk), replace(DAZ, rest=3), turns=turns)
    assert found(tmp_path, lying(walk), DAZ).source == "the zero pose"


def test_a_wrong_up_axis_is_refused(tmp_path: Path, walk: Clip) -> None:
    with refuse(tmp_path / "clip.bvh", "degrees from up", "another up"):
        found(tmp_path, walk, replace(DAZ, up="z"))
    with refuse(tmp_path / "clip.bvh", "degrees from up", "another up"):
        found(tmp_path, walk, DAZ, written=replace(DAZ, up="z"))


def test_hips_at_one_place_are_refused(tmp_path: Path) -> None:
    bvh = read(tmp_path, "cmu_daz")
    offsets = bvh.offsets.copy()
    offsets[[bvh.names.index(name) for name in ("lButtock", "rButtock")]] = 0
    chosen = load_skeleton("cmu_daz")
    flat = replace(bvh, offsets=offsets)
    with refuse(bvh.path, "the hips are at the same place"):
        find_stance(flat, chosen, pick_joints(flat, chosen))
    nothing = replace(bvh, offsets=bvh.offsets * 0, values=bvh.values * 0)
    with refuse(bvh.path, "pelvis and head are at the same place"):
        find_stance(nothing, chosen, pick_joints(nothing, chosen))


# Left and right


def swapped(chosen: SkeletonMap, parts: tuple[str, ...]) -> SkeletonMap:
    """The map with the left ones of some joints for the right ones."""
    other = {"left": "right", "right": "left"}
    joints = {}
    for joint in chosen.joints:
        side, _, part = joint.partition("_")
        joints[joint] = chosen.joints[f"{other[side]}_{part}" if part in parts else joint]
    return replace(chosen, joints=joints)


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize(
    ("parts", "said"),
    [
        ((*ARM, *LEG), "the feet point backward, so left and right may be swapped"),
        (ARM, "the left shoulder is on the side of the right hip"),
        (LEG, "the left shoulder is on the side of the right hip"),
    ],
)
def test_swapped_sides_are_refused(
    tmp_path: Path, walk: Clip, parts: tuple[str, ...], said: str, turned: bool
) -> None:
    turns = random_turns(own_tree(DAZ), 1) if turned else None
    if turned and "hip" in parts:
        said = "bends forward: left and right"
    with refuse(tmp_path / "clip.bvh", said):
        found(tmp_path, walk, swapped(DAZ, parts), turns=turns)


def test_joints_of_a_leg_that_stand_for_others_are_refused(tmp_path: Path, walk: Clip) -> None:
    """The ankle as a knee makes a leg that bends forward."""
    joints = DAZ.joints | {"left_knee": "lFoot", "left_ankle": "lFoot.end"}
    del joints["left_foot"]
    with refuse(tmp_path / "clip.bvh", "left_knee bends forward: left and right, or the joints of the leg"):
        found(tmp_path, walk, replace(DAZ, joints=joints))


def test_mirrored_bones_are_refused(tmp_path: Path) -> None:
    bvh, chosen = read(tmp_path, "cmu_daz"), load_skeleton("cmu_daz")
    behind = replace(bvh, offsets=bvh.offsets * [-1, 1, 1])
    with refuse(bvh.path, "the feet point backward, so left and right may be swapped"):
        find_stance(behind, chosen, pick_joints(behind, chosen))


# A map's rest


def test_the_pose_of_a_map(tmp_path: Path, walk: Clip) -> None:
    turns = rest_turns(BANDAI, own_tree(BANDAI))
    stance = found(tmp_path, walk, BANDAI, BANDAI, turns)
    assert (stance.source, stance.straight) == ("the map's rest pose", False)


def leaning(degrees: float) -> list[float]:
    """The spine's rotation values in the map's rest, leaning forward."""
    assert isinstance(BANDAI.rest, dict)
    hips, spine = (Rotation.from_euler("ZXY", BANDAI.rest[name], degrees=True) for name in ("Hips", "Spine"))
    lean = Rotation.from_euler("x", degrees, degrees=True)
    return (hips.inv() * lean * hips * spine).as_euler("ZXY", degrees=True).tolist()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"Spine": leaning(80.0)}, "pelvis to head is 7"),
        ({"Spine": [0.0, 0.0, 0.0]}, "the left shoulder is on the side of the right hip"),
        ({"Hips": [0.0, 0.0, 0.0]}, "rest of skeleton bandai_namco is no person who stands"),
        ({"Chest": [-0.1, 180.0, 0.0]}, "the left shoulder is on the side of the right hip"),
        ({"UpperLeg_L": [0.0, 0.0, 0.0]}, "left_hip to left_knee is"),
        ({"Foot_R": [-0.6, 186.9, -65.9], "Foot_L": [-0.6, 186.9, -65.9]}, "the feet point backward"),
        ({"Spine": [90.0, 86.2]}, "2 rotations for Spine; allowed: 3"),
    ],
)
def test_a_folded_pose_of_a_map_is_refused(
    tmp_path: Path, walk: Clip, change: dict[str, list[float]], said: str
) -> None:
    """Bones along their parents' X axes, as the data's are, in the map's rest but for one joint."""
    assert isinstance(BANDAI.rest, dict)
    turns = rest_turns(BANDAI, own_tree(BANDAI))
    chosen = replace(BANDAI, rest={**BANDAI.rest, **change})
    with refuse(tmp_path / "clip.bvh", said):
        found(tmp_path, walk, chosen, BANDAI, turns)
