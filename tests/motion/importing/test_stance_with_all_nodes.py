"""The stance that is shown: the one that importing reads, with all nodes, and the body as it stands alike."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bvh_samples import write
from skeleton_families import walking

from memmlp.motion.body import JOINTS, builtin_rest_joints
from memmlp.motion.formats.bvh import read_bvh
from memmlp.motion.importing.skeleton_map import find_skeleton
from memmlp.motion.importing.stance_with_all_nodes import StanceWithAllNodes, find_stance_with_all_nodes

REST = builtin_rest_joints()


def stance(folder: Path, name: str, turned: bool) -> StanceWithAllNodes:
    bvh = read_bvh(write(folder, walking(name, turned).text()))
    return find_stance_with_all_nodes(bvh, find_skeleton(bvh), REST)


@pytest.mark.parametrize(
    ("name", "turned", "source"),
    [("mixamo", False, "zero pose"), ("lafan1", True, "straightest"), ("cmu_daz", False, "zero pose")],
)
def test_the_body_stands_as_the_file_does(tmp_path: Path, name: str, turned: bool, source: str):
    found = stance(tmp_path, name, turned)
    assert source in found.source
    assert found.positions.shape == (len(found.nodes), 3)
    for start, end in (("left_hip", "left_knee"), ("right_elbow", "right_wrist"), ("neck", "head")):
        there = found.positions[found.mapped[end]] - found.positions[found.mapped[start]]
        here = found.body[JOINTS.index(end)] - found.body[JOINTS.index(start)]
        assert there @ here > 0.999 * np.linalg.norm(there) * np.linalg.norm(here)
    hips = found.positions[found.mapped["left_hip"]] - found.positions[found.mapped["right_hip"]]
    assert hips[0] > 0
    assert abs(hips[2]) < 1e-6


def test_unmapped_nodes_are_in_the_same_pose(tmp_path: Path):
    straight, turned = (stance(tmp_path, "mixamo", turned) for turned in (False, True))
    for each in (straight, turned):
        top, head = (each.positions[each.nodes.index(node)] for node in ("HeadTop_End", "Head"))
        assert 0.15 < top[1] - head[1] < 0.25
