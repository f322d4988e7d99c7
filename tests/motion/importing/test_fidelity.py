"""The comparison of a clip with its file can fail, names what is worst, and knows what people look like."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bvh_samples import TREES, own_tree, performed, person, tree, write
from scipy.spatial.transform import Rotation

from memmlp.motion.body import JOINTS, make_builtin_rest_joints
from memmlp.motion.clip import Clip
from memmlp.motion.formats.bvh import read_bvh
from memmlp.motion.importing.convert import Conversion, convert_recording
from memmlp.motion.importing.fidelity import compare_with_recording
from memmlp.motion.importing.skeleton_map import SkeletonMap, load_skeleton
from memmlp.motion.synthetic import synthesize_clip

REST = make_builtin_rest_joints()
JOINT = {name: index for index, name in enumerate(JOINTS)}


def converted(path: Path, chosen: SkeletonMap) -> Conversion:
    return convert_recording(read_bvh(path), chosen, REST, name="clip", fps=120.0)


@pytest.mark.parametrize("skeleton", TREES)
def test_imports_keep_joints_and_limbs(tmp_path: Path, skeleton: str) -> None:
    path = write(tmp_path, person(skeleton, 40, 5).text())
    fidelity = converted(path, load_skeleton(skeleton)).fidelity
    assert (fidelity.skeleton, fidelity.frames) == (skeleton, 39)
    assert fidelity.mm.value < 0.01
    assert fidelity.degrees.value < 3


@pytest.fixture
def walk(tmp_path: Path) -> Conversion:
    chosen = load_skeleton("cmu_daz")
    file = performed(chosen, synthesize_clip("walking", 1, seconds=2.0), sample=tree("cmu_daz"))
    return converted(write(tmp_path, file.text()), chosen)


def test_a_right_import_has_no_fault_and_a_head_that_flips_for_a_while_is_said(walk: Conversion) -> None:
    assert walk.fidelity.faults == ()
    again = compare_with_recording(walk.clip, walk.fitted.motion, REST, "cmu_daz")
    assert again == walk.fidelity
    flipped = bent(walk.clip, "head", slice(40, 46), [0.0, 0.0, np.pi])
    said = compare_with_recording(flipped, walk.fitted.motion, REST, "cmu_daz").faults
    assert any(f"{6 / len(flipped):.0%} of the frames, first in frame 40" in fault for fault in said)


def bent(clip: Clip, joint: str, frame: int | slice, vector: list[float]) -> Clip:
    poses = clip.poses.copy()
    poses[frame, JOINT[joint]] += vector
    return replace(clip, poses=poses)


@pytest.mark.parametrize(("joint", "segment"), [
    ("spine2", None), ("left_elbow", "left_elbow to left_wrist"), ("right_hip", "right_hip to right_knee"),
])  # fmt: skip
def test_a_joint_that_is_off_in_one_frame_is_named(walk: Conversion, joint: str, segment: str | None) -> None:
    clip = bent(walk.clip, joint, 31, [0.0, 0.1, 0.25])
    fidelity = compare_with_recording(clip, walk.fitted.motion, REST, "cmu_daz")
    assert fidelity.degrees.value > 3
    assert (fidelity.mm.frame, fidelity.degrees.frame) == (31, 31)
    assert any("in frame 31" in fault for fault in fidelity.faults)
    assert segment in (None, fidelity.degrees.where)  # spine2 carries several


def faults(folder: Path, written: SkeletonMap, chosen: SkeletonMap, **how: np.ndarray) -> tuple[str, ...]:
    """What is said of a walk that is written by one map and read by another."""
    file = performed(written, synthesize_clip("walking", 1, seconds=2.0), **how)
    return converted(write(folder, file.text()), chosen).fidelity.faults


DAZ = replace(load_skeleton("cmu_daz"), calibration_frame=False)


@pytest.mark.parametrize(("changes", "said"), [
    ({"left_ankle": "lFoot.end", "left_foot": None}, "left_knee to left_ankle changes its length by"),
    ({"left_shoulder": "lCollar", "left_collar": None}, "left_shoulder to left_elbow is 0.33 m long"),
    ({"head": "abdomen", **dict.fromkeys(("spine1", "spine2", "neck", "left_collar", "right_collar"))},
     "pelvis to head is 0."),
])  # fmt: skip
def test_joints_that_stand_for_others_are_said(tmp_path: Path, changes: dict[str, str | None], said: str):
    joints = {joint: node for joint, node in (DAZ.joints | changes).items() if node is not None}
    told = faults(tmp_path, DAZ, replace(DAZ, joints=joints))
    assert [fault for fault in told if said in fault], told


def test_swapped_sides_without_toes_and_a_small_unit_are_said(tmp_path: Path) -> None:
    other = {"left": "right", "right": "left"}
    joints = {}
    for joint in DAZ.joints:
        side, _, part = joint.partition("_")
        if part != "foot":
            joints[joint] = DAZ.joints[f"{other[side]}_{part}" if part else joint]
    said = faults(tmp_path, DAZ, replace(DAZ, joints=joints))
    assert any(fault.startswith("the knees bend backwards") for fault in said)
    said = faults(tmp_path, DAZ, replace(DAZ, unit=0.0045))
    assert said == ("the legs are 0.34 m long, so the unit may be wrong",)


def test_hips_that_turn_below_the_pelvis_are_said(tmp_path: Path) -> None:
    """As where another program turns the joint above the hip, which its own files never turn."""
    name, file = "cmu_motionbuilder", tree("cmu_motionbuilder")
    written = performed(load_skeleton(name), synthesize_clip("walking", 1, seconds=1.0), sample=file)
    column = 3 + 3 * file.names.index("LHipJoint")
    for degrees in (0.0, 20.0):
        written.values[:, column : column + 3] = [degrees, 0, 0]
        told = "; ".join(converted(write(tmp_path, written.text()), load_skeleton(name)).fidelity.faults)
        assert ("left_hip moves relative to the pelvis by" in told) == bool(degrees)


def test_palms_that_face_elsewhere_are_said(tmp_path: Path) -> None:
    """A T-pose whose arms are turned about themselves, which only the axes of the elbows show."""
    sample = own_tree(DAZ)
    turns = np.tile(np.eye(3), (len(sample.names), 1, 1))
    for name in ("lShldr", "lForeArm", "lHand"):
        turns[sample.names.index(name)] = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    said = faults(tmp_path, DAZ, DAZ, turns=turns)
    assert len(said) == 1
    assert said[0].startswith("left_elbow bends about an axis ")
