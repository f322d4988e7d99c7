"""Recordings -> clips: segments point as in the file; axes, scale, calibration; performances come back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from bvh_samples import (
    TREES,
    Sample,
    own_tree,
    performed,
    person,
    random_turns,
    read,
    refuse,
    rest_turns,
    tree,
    write,
)
from scipy.spatial.transform import Rotation

from memmlp.motion.body import JOINTS, builtin_rest_joints
from memmlp.motion.clip import Clip
from memmlp.motion.formats.bvh import Bvh, read_bvh
from memmlp.motion.formats.recording import END
from memmlp.motion.geometry import axis_angle_to_matrix, forward_kinematics
from memmlp.motion.importing.anatomy import segments
from memmlp.motion.importing.convert import NONE, convert
from memmlp.motion.importing.retarget import Retargeting, Stance, find_stance, fit
from memmlp.motion.importing.skeleton_map import SkeletonMap, find_skeleton, load_skeleton, pick_joints
from memmlp.motion.synthetic import synthesize_clip

REST = builtin_rest_joints()
JOINT = {name: index for index, name in enumerate(JOINTS)}


def imported(bvh: Bvh, chosen: SkeletonMap, rest: np.ndarray = REST) -> Clip:
    """The clip, its floor as in the file."""
    return convert(bvh, chosen, rest, name="clip", floor=NONE).clip


def fitted(bvh: Bvh, chosen: SkeletonMap, rest: np.ndarray = REST) -> Retargeting:
    return fit(bvh, chosen, pick_joints(bvh, chosen), rest)


def on_body(clip: Clip, body: np.ndarray = REST) -> tuple[np.ndarray, np.ndarray]:
    """Global rotations (N, 22, 3, 3) and positions (N, 22, 3)."""
    rest = torch.from_numpy(body)
    root = rest[0] + torch.from_numpy(clip.trans)
    poses = torch.from_numpy(clip.poses).double()
    rotations, positions = forward_kinematics(axis_angle_to_matrix(poses), root, rest)
    return rotations.numpy(), positions.numpy()


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def to_z_up(vectors: np.ndarray) -> np.ndarray:
    return np.stack([vectors[..., 0], -vectors[..., 2], vectors[..., 1]], -1)


# Directions


@pytest.mark.parametrize("skeleton", TREES)
def test_segments_point_as_in_the_file(tmp_path: Path, skeleton: str) -> None:
    """Exactly, and though the unmapped joints between mapped ones turn too."""
    bvh, chosen = read(tmp_path, skeleton, folded=True), load_skeleton(skeleton)
    positions = to_z_up(bvh.kinematics()[1])[1:]
    body = on_body(imported(bvh, chosen))[1]
    mapped = np.array([name in chosen.joints for name in JOINTS])
    pairs = [segment for segment in segments(mapped) if segment.start > 0]
    for joint, child in (*pairs, (JOINT["right_hip"], JOINT["left_hip"])):
        start, end = (bvh.nodes.index(chosen.joints[JOINTS[index]]) for index in (joint, child))
        if np.linalg.norm(bvh.zero_pose()[end] - bvh.zero_pose()[start]) < 1e-6:
            continue
        expected = unit(positions[:, end] - positions[:, start])
        np.testing.assert_allclose(unit(body[:, child] - body[:, joint]), expected, atol=1e-9)


def test_another_body_keeps_limbs_too(tmp_path: Path) -> None:
    rest = REST * [1.2, 0.8, 1.1] + [0.1, -0.2, 0.3]
    rest[JOINT["left_elbow"], 1] -= 0.1
    bvh, chosen = read(tmp_path, "cmu_daz"), load_skeleton("cmu_daz")
    body = on_body(imported(bvh, chosen, rest), rest)[1]
    positions = to_z_up(bvh.kinematics()[1])[1:]
    start, end = bvh.nodes.index("lShldr"), bvh.nodes.index("lForeArm")
    hips = [bvh.nodes.index("lThigh"), bvh.nodes.index("rThigh")]
    middle = positions[:, hips].mean(1) * chosen.unit * fitted(bvh, chosen, rest).scale
    np.testing.assert_allclose(body[:, [1, 2]].mean(1), middle, atol=1e-9)
    arm = body[:, JOINT["left_elbow"]] - body[:, JOINT["left_shoulder"]]
    np.testing.assert_allclose(unit(arm), unit(positions[:, end] - positions[:, start]), atol=1e-9)


# Axes, scale, calibration


@pytest.mark.parametrize("skeleton", TREES)
def test_a_standing_person_stands(tmp_path: Path, skeleton: str) -> None:
    """The file's zero pose, on the file's floor: upright in z, facing -y, left on +x, soles on the floor."""
    sample = person(skeleton, 2, 0)
    sample.values[:] = 0
    bvh, chosen = read_bvh(write(tmp_path, sample.text())), load_skeleton(skeleton)
    toes = bvh.zero_pose()[[bvh.nodes.index(chosen.joints[foot]) for foot in ("left_foot", "right_foot")], 1]
    sample.values[:, 1] = -toes.mean()
    clip = imported(read_bvh(write(tmp_path, sample.text())), chosen)
    at = dict(zip(JOINTS, on_body(clip)[1][0], strict=True))
    assert 1.3 < at["head"][2] < 1.7
    assert 0.7 < at["pelvis"][2] - at["left_ankle"][2] < 1.0
    assert abs(at["left_foot"][2]) < 0.06
    assert at["left_wrist"][0] > 0.5 and at["right_wrist"][0] < -0.5  # noqa: PT018
    assert at["left_foot"][1] < at["left_ankle"][1] - 0.05
    rotations = np.linalg.norm(clip.poses[0], axis=-1)
    assert rotations[JOINT["pelvis"]] == pytest.approx(np.pi / 2, abs=0.15)
    assert np.degrees(rotations[1:]).max() < 35
    wrists = [JOINT["left_wrist"], JOINT["right_wrist"]]
    np.testing.assert_allclose(rotations[wrists], 0, atol=1e-9)


def test_up_axis(tmp_path: Path) -> None:
    """The same motion in a Z-up file gives the same clip."""
    sample, chosen = person("cmu_daz", 6, 2), load_skeleton("cmu_daz")
    expected = imported(read_bvh(write(tmp_path, sample.text())), chosen)
    moved, values = replace(sample), sample.values.copy()
    moved.offsets = to_z_up(np.array(sample.offsets)).tolist()
    moved.ends = [(joint, to_z_up(np.array(offset)).tolist()) for joint, offset in sample.ends]
    values[:, :3] = to_z_up(values[:, :3])
    column, channels = 3, []
    for names in sample.channels:
        rotations = [name for name in names if name.endswith("rotation")]
        for name in rotations:  # a turn about y is one about z, a turn about z one about -y
            values[:, column] *= -1 if name[0] == "Z" else 1
            column += 1
        renamed = [{"X": "X", "Y": "Z", "Z": "Y"}[name[0]] + name[1:] for name in rotations]
        channels.append((*names[: len(names) - len(rotations)], *renamed))
    moved.channels, moved.values = channels, values
    clip = imported(read_bvh(write(tmp_path, moved.text())), replace(chosen, up="z"))
    np.testing.assert_allclose(clip.trans, expected.trans, atol=1e-9)
    turned = Rotation.from_rotvec(clip.poses.reshape(-1, 3)).inv() * Rotation.from_rotvec(
        expected.poses.reshape(-1, 3)
    )
    assert turned.magnitude().max() < 1e-7


def test_translation_is_scaled_by_the_legs(tmp_path: Path) -> None:
    sample = person("cmu_daz", 3, 0)
    sample.values[:] = 0
    sample.values[2, :3] = [10, 2, -5]
    bvh = read_bvh(write(tmp_path, sample.text()))
    legs = [np.linalg.norm(REST[child] - REST[joint]) for joint, child in ((1, 4), (4, 7))]
    source = np.linalg.norm([0, -36.8, 0.7]) + np.linalg.norm([-0.7, -45.1, -5.1])
    moved = np.diff(imported(bvh, load_skeleton("cmu_daz")).trans, axis=0)[0]
    np.testing.assert_allclose(moved, np.array([10, 5, 2]) * sum(legs) / source, atol=1e-9)


def test_calibration_frame_is_dropped(tmp_path: Path) -> None:
    bvh, chosen = read(tmp_path, "cmu_daz", frames=6), load_skeleton("cmu_daz")
    dropped, kept = imported(bvh, chosen), imported(bvh, replace(chosen, calibration_frame=False))
    assert (len(dropped), len(kept)) == (5, 6)
    np.testing.assert_array_equal(dropped.poses, kept.poses[1:])
    np.testing.assert_array_equal(dropped.trans, kept.trans[1:])
    with refuse(tmp_path / "clip.bvh", "only the calibration frame"):
        imported(read(tmp_path, "cmu_daz", frames=1), chosen)
    with refuse(tmp_path / "clip.bvh", "only the calibration frame"):  # from which no up axis is found either
        imported(read(tmp_path, "cmu_daz", frames=1), replace(chosen, up=None))


# Motion of people


@pytest.mark.parametrize("skeleton", TREES)
def test_a_performance_comes_back_from_its_file(tmp_path: Path, skeleton: str) -> None:
    """The embedded motion, written as a file of the skeleton: all joints that it has are where they were."""
    clip, chosen, sample = (
        synthesize_clip("reaching", 0, seconds=2.0),
        load_skeleton(skeleton),
        tree(skeleton),
    )
    corrections = fitted(zero_pose(sample), chosen).corrections
    file = performed(chosen, clip, sample=sample, corrections=corrections)
    bvh = read_bvh(write(tmp_path, file.text("\r\n")))
    found = imported(bvh, find_skeleton(bvh))
    assert (len(found), found.fps) == (len(clip), 120)
    known = [joint for joint, name in enumerate(JOINTS) if not chosen.joints.get(name, END).endswith(END)]
    turned = on_body(found)[0][:, known].swapaxes(-1, -2) @ on_body(clip)[0][:, known]
    angles = Rotation.from_matrix(turned.reshape(-1, 3, 3)).magnitude()
    assert np.degrees(angles.max()) < 0.01


def zero_pose(sample: Sample) -> Bvh:
    return replace(sample, values=np.zeros((2, sample.values.shape[1]))).hierarchy()


# The stance from which a skeleton is read, and what is refused by name


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


@pytest.mark.parametrize("degrees", [180, -37])
def test_a_zero_pose_that_stands_serves(tmp_path: Path, walk: Clip, degrees: float) -> None:
    """Whichever way it faces, it is turned to face +Z."""
    stance = found(tmp_path, walk, DAZ, turns=whole(Rotation.from_euler("y", degrees, degrees=True)))
    assert (stance.source, stance.straight) == ("the zero pose", True)
    left = stance.positions[1] - stance.positions[2]
    np.testing.assert_allclose(left / np.linalg.norm(left), [1, 0, 0], atol=1e-6)
    assert (stance.positions[10] - stance.positions[7])[2] > 0


@pytest.mark.parametrize(("axis", "degrees"), [("x", 90), ("z", 180)])
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
    with refuse(tmp_path / "clip.bvh", "rest=60"):
        found(tmp_path, walk, replace(DAZ, rest=60))


def lying(clip: Clip) -> Clip:
    poses = clip.poses.astype(float)
    poses[:, 0] = (Rotation.from_rotvec([1.5, 0, 0]) * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    return replace(clip, poses=poses)


def test_who_never_stands_is_refused(tmp_path: Path, walk: Clip) -> None:
    turns = random_turns(own_tree(DAZ), 1)
    with refuse(tmp_path / "clip.bvh", "stands neither in the zero pose (", "nor in any frame (at best, "):
        found(tmp_path, lying(walk), DAZ, turns=turns)
    with refuse(tmp_path / "clip.bvh", "rest=3: pelvis to head is"):
        found(tmp_path, lying(walk), replace(DAZ, rest=3), turns=turns)
    assert found(tmp_path, lying(walk), DAZ).source == "the zero pose"


def test_a_wrong_up_axis_is_refused(tmp_path: Path, walk: Clip) -> None:
    with refuse(tmp_path / "clip.bvh", "degrees from up"):
        found(tmp_path, walk, replace(DAZ, up="z"))
    with refuse(tmp_path / "clip.bvh", "degrees from up"):
        found(tmp_path, walk, DAZ, written=replace(DAZ, up="z"))


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


# A map's rest


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
        ({"Hips": [0.0, 0.0, 0.0]}, "rest of skeleton bandai_namco"),
        ({"Foot_R": [-0.6, 186.9, -65.9], "Foot_L": [-0.6, 186.9, -65.9]}, "the feet point backward"),
        ({"Spine": [90.0, 86.2]}, "rest.Spine has 2 values"),
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
