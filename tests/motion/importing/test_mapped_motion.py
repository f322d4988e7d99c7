"""The joints that a map picks from a recording, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bvh_samples import TREES, read, refuse

from memmlp.motion.body import JOINTS
from memmlp.motion.importing.mapped_motion import pick_joints
from memmlp.motion.importing.skeleton_map import load_skeleton


@pytest.mark.parametrize("skeleton", TREES)
def test_joints_are_those_of_the_map(tmp_path: Path, skeleton: str) -> None:
    bvh, chosen = read(tmp_path, skeleton), load_skeleton(skeleton)
    mapped_motion = pick_joints(bvh, chosen)
    positions = bvh.kinematics()[1][1:] * chosen.unit
    assert len(mapped_motion) == len(bvh) - 1
    for joint, name in enumerate(JOINTS):
        assert mapped_motion.mapped[joint] == (name in chosen.joints)
        if name in chosen.joints:
            node = bvh.nodes.index(chosen.joints[name])
            np.testing.assert_array_equal(mapped_motion.positions[:, joint], positions[:, node])


def test_a_joint_without_counterpart_is_its_parent(tmp_path: Path) -> None:
    mapped_motion = pick_joints(read(tmp_path, "cmu_daz"), load_skeleton("cmu_daz"))
    spine2, spine3 = JOINTS.index("spine2"), JOINTS.index("spine3")
    assert mapped_motion.nodes[spine3] == mapped_motion.nodes[spine2]
    np.testing.assert_array_equal(mapped_motion.positions[:, spine3], mapped_motion.positions[:, spine2])


def test_a_map_of_other_joints_is_refused(tmp_path: Path) -> None:
    bvh, chosen = read(tmp_path, "cmu_daz"), load_skeleton("cmu_daz")
    with refuse(bvh.path, "Hips"):
        pick_joints(bvh, load_skeleton("cmu_motionbuilder"))
    swapped = chosen.joints | {"left_knee": "lFoot", "left_ankle": "lShin"}
    with refuse(bvh.path, "lShin is not below lFoot"):
        pick_joints(bvh, replace(chosen, joints=swapped))
