"""The comparison of a clip with its file can fail, names what is worst, and knows what people look like."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bvh_samples import TREES, performed, person, tree, write

from memmlp.motion.body import JOINTS, builtin_rest_joints
from memmlp.motion.clip import Clip
from memmlp.motion.formats.bvh import read_bvh
from memmlp.motion.importing.convert import Converted, convert
from memmlp.motion.importing.fidelity import compare
from memmlp.motion.importing.skeleton import SkeletonMap, load_skeleton
from memmlp.motion.synthetic import synthesize_clip

REST = builtin_rest_joints()
JOINT = {name: index for index, name in enumerate(JOINTS)}


def converted(path: Path, chosen: SkeletonMap) -> Converted:
    return convert(read_bvh(path), chosen, REST, name="clip")


@pytest.mark.parametrize("skeleton", TREES)
def test_imports_keep_joints_and_limbs(tmp_path: Path, skeleton: str) -> None:
    path = write(tmp_path, person(skeleton, 40, 5).text())
    fidelity = converted(path, load_skeleton(skeleton)).fidelity
    assert (fidelity.skeleton, fidelity.frames) == (skeleton, 39)
    assert fidelity.mm.value < 0.01
    assert fidelity.degrees.value < 3


def test_a_turning_joint_without_counterpart_shows(tmp_path: Path) -> None:
    """A buttock that turns moves the thigh on a bone that the import lacks."""
    path = write(tmp_path, person("cmu_daz", 10, 5, folded=True).text())
    assert converted(path, load_skeleton("cmu_daz")).fidelity.mm.value > 1


@pytest.fixture
def walk(tmp_path: Path) -> Converted:
    chosen = load_skeleton("cmu_daz")
    file = performed(chosen, synthesize_clip("walking", 1, seconds=2.0), sample=tree("cmu_daz"))
    return converted(write(tmp_path, file.text()), chosen)


def test_a_right_import_has_no_fault(walk: Converted) -> None:
    assert walk.fidelity.faults == ()
    again = compare(walk.clip, walk.performance, REST, "cmu_daz")
    assert again == walk.fidelity


def bent(clip: Clip, joint: str, frame: int | slice, vector: list[float]) -> Clip:
    poses = clip.poses.copy()
    poses[frame, JOINT[joint]] += vector
    return replace(clip, poses=poses)


@pytest.mark.parametrize(
    ("joint", "segment"),
    [
        ("spine2", "spine2 to neck"),
        ("neck", "neck to head"),
        ("left_elbow", "left_elbow to left_wrist"),
        ("right_hip", "right_hip to right_knee"),
        ("left_ankle", "left_ankle to left_foot"),
        ("right_collar", "right_collar to right_shoulder"),
    ],
)
def test_a_joint_that_is_off_in_one_frame_is_named(walk: Converted, joint: str, segment: str) -> None:
    clip = bent(walk.clip, joint, 31, [0.0, 0.1, 0.25])
    fidelity = compare(clip, walk.performance, REST, "cmu_daz")
    assert fidelity.degrees.value > 3
    assert (fidelity.mm.frame, fidelity.degrees.frame) == (31, 31)
    assert any("in frame 31" in fault for fault in fidelity.faults)
    if joint != "spine2":  # which carries more than one segment
        assert fidelity.degrees.where == segment


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda c: bent(c, "head", slice(None), [0.0, np.pi, 0.0]), "the head is turned by"),
        (lambda c: replace(c, trans=c.trans + np.array([0, 0, 0.7])), "the feet stay 0."),
        (lambda c: replace(c, trans=c.trans - np.array([0, 0, 0.7])), "m below the floor"),
        (lambda c: bent(c, "spine1", slice(None), [2.8, 0.0, 0.0]), "the head is below the pelvis in"),
    ],
)
def test_what_no_person_does_is_said(walk: Converted, change: Callable[[Clip], Clip], said: str) -> None:
    faults = compare(change(walk.clip), walk.performance, REST, "cmu_daz").faults
    assert any(said in fault for fault in faults)


def test_segments_that_stretch_are_said(walk: Converted) -> None:
    positions = walk.performance.positions.copy()
    positions[10:, JOINT["left_wrist"]] += 0.1
    faults = compare(walk.clip, replace(walk.performance, positions=positions), REST, "cmu_daz").faults
    assert any("left_elbow to left_wrist changes its length by" in fault for fault in faults)
