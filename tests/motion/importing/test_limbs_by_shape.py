"""Limbs of a tree, found without a name."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bvh_samples import Sample
from skeleton_families import FAMILIES, family

from memmlp.motion.importing.limbs_by_shape import find_limbs, middle, read_tree
from memmlp.motion.importing.skeleton_map import load_skeleton


def tree(sample: Sample):
    values = np.zeros((2, sum(map(len, sample.channels))))
    return read_tree(replace(sample.hierarchy(), values=values), calibration_frame=True)


@pytest.mark.parametrize("name", FAMILIES)
def test_limbs_begin_and_end_where_the_map_has_them(name: str):
    whole, joints = tree(family(name)), load_skeleton(name).joints
    limbs = find_limbs("file", whole)
    node = {joint: whole.nodes.index(name) for joint, name in joints.items()}
    for pair, parts in ((limbs.legs, ("hip", "knee", "ankle")), (limbs.arms, ("shoulder", "elbow", "wrist"))):
        at = middle(whole, pair.chains)
        found = {chain[at - 1 : at + 2] for chain in pair.chains}
        assert found == {tuple(node[f"{side}_{part}"] for part in parts) for side in ("left", "right")}
    assert limbs.trunk[0] == node["pelvis"]
    assert node["head"] in limbs.head
    assert not set(limbs.trunk) & set(limbs.head)


def test_a_head_known_by_name_is_not_sought():
    sample = family("lafan1")  # a plume longer than neck and head
    sample.names += ["Plume", "Plume1"]
    sample.parents += [sample.names.index("Spine2"), len(sample.names) - 2]
    sample.offsets += [[0.0, 30.0, -10.0], [0.0, 90.0, 0.0]]
    sample.channels += [sample.channels[-1]] * 2
    whole = tree(sample)
    head = whole.nodes.index("Head")
    assert head not in find_limbs("file", whole).head
    assert head in find_limbs("file", whole, head).head


def test_an_elbow_is_not_between_a_long_collar_bone_and_the_upper_arm():
    sample = family("cmu_motionbuilder")
    sample.offsets[sample.names.index("LeftArm")] = [3.5, 0.0, 0.0]
    sample.offsets[sample.names.index("RightArm")] = [-3.5, 0.0, 0.0]
    whole = tree(sample)
    arms = find_limbs("file", whole).arms
    elbows = {whole.nodes[chain[middle(whole, arms.chains)]] for chain in arms.chains}
    assert elbows == {"LeftForeArm", "RightForeArm"}


def test_short_bones_may_differ_between_the_sides():
    sample = family("cmu_motionbuilder")
    sample.offsets[sample.names.index("LeftShoulder")] = [0.2, 0.0, 0.0]  # 1 cm, and none on the right
    whole = tree(sample)
    arms = find_limbs("file", whole).arms
    assert {whole.nodes[chain[0]] for chain in arms.chains} == {"LeftShoulder", "RightShoulder"}


def test_a_thousand_joints_are_no_burden():
    """Only the longest pairs are compared with each other, however many chains leave from one node."""
    sample = family("lafan1")
    for comb in range(150):
        for step in range(3):
            parent = sample.names.index("Spine") if step == 0 else len(sample.names) - 1
            sample.names.append(f"tooth{comb}_{step}")
            sample.parents.append(parent)
            sample.offsets.append([0.0, 2.0, 0.0])
            sample.channels.append(sample.channels[-1])
    whole = tree(sample)
    limbs = find_limbs("file", whole)
    assert {whole.nodes[chain[0]] for chain in limbs.legs.chains} == {"LeftUpLeg", "RightUpLeg"}
