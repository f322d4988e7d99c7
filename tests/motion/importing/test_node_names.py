"""Names of nodes: namespaces, spellings, sides, and no shipped map that fits the files of another."""

from __future__ import annotations

import pytest
from bvh_samples import own_tree
from skeleton_families import FAMILIES, family, renamed

from memmlp.motion.importing.node_names import find_nodes, keys, without_namespace, words
from memmlp.motion.importing.skeleton_map import find_skeleton, load_skeleton, shipped_skeletons


@pytest.mark.parametrize(
    ("nodes", "plain"),
    [
        (["mixamorig:Hips", "mixamorig:LeftArm"], ["Hips", "LeftArm"]),
        (["mixamorig1:Hips", "mixamorig1:Hips.end"], ["Hips", "Hips.end"]),
        (["mixamorigHips", "mixamorigLeftArm"], ["Hips", "LeftArm"]),
        (["Character1_Hips", "Character1_LeftArm"], ["Hips", "LeftArm"]),
        (["m_avg_root", "m_avg_L_Hip", "m_avg_R_Hip"], ["root", "L_Hip", "R_Hip"]),
        (["Armature", "a:b:Hips", "a:b:Head"], ["Armature", "Hips", "Head"]),
        (["LeftArm", "LeftForeArm"], ["Arm", "ForeArm"]),
        (["Hips", "Head"], ["Hips", "Head"]),
        (["Spine", "Spine1", "Spine2"], ["Spine", "Spine1", "Spine2"]),
        (["a:Hips", "b:Hips"], ["a:Hips", "b:Hips"]),
        (["joint_1", "joint_2", "joint_2.end"], ["1", "2", "2.end"]),
    ],
)
def test_namespaces_are_left_out(nodes: list[str], plain: list[str]):
    assert without_namespace(nodes) == plain


def test_spellings_are_alike():
    assert (
        len(set(keys(["Left_hip", "Head"])[:1] + keys(["LEFT-HIP", "x"])[:1] + keys(["LeftHip", "x"])[:1]))
        == 1
    )
    assert keys(["lFoot", "lFoot.end", "hip"]) == ["lfoot", "lfoot.end", "hip"]


def test_nodes_are_found_by_their_very_name_first():
    nodes = ["Spine1", "spine_1", "Head"]
    assert find_nodes(nodes, ["spine_1"]) == {"spine_1": "spine_1"}
    assert find_nodes(nodes, ["SPINE1"]) is None  # either could be meant
    assert find_nodes(nodes, ["Head", "head"]) is None  # one node for two
    assert find_nodes(nodes, ["Tail"]) is None


@pytest.mark.parametrize(
    ("name", "side", "word"),
    [
        ("LeftUpLeg", "left", "upleg"),
        ("lShldr", "left", "shldr"),
        ("UpperArm_L", "left", "upperarm"),
        ("upper_arm.R", "right", "upperarm"),
        ("LHipJoint", "left", "hipjoint"),
        ("lfemur", "left", "femur"),
        ("rclavicle", "right", "clavicle"),
        ("leftupleg", "left", "upleg"),
        ("lowerback", "", "lowerback"),
        ("root", "", "root"),
        ("RightHandThumb1", "right", "handthumb1"),
        ("thigh_l", "left", "thigh"),
        ("LeftRight", "", "leftright"),
    ],
)
def test_words(name: str, side: str, word: str):
    known = frozenset({"femur", "clavicle", "upleg"})
    assert words(name, known) == (side, word)


@pytest.mark.parametrize("name", FAMILIES)
@pytest.mark.parametrize("prefix", ["", "mixamorig:", "Character1_"])
def test_each_familys_file_is_known_by_its_own_map(name: str, prefix: str):
    bvh = family(name).hierarchy()
    bvh = renamed(bvh, {joint: prefix + joint for joint in bvh.names})
    found = find_skeleton(bvh)
    behind = {"memmlp": "smpl_words"}  # the same joints, and it presumes less
    assert found.name == behind.get(name, name)
    assert set(found.joints.values()) <= set(bvh.nodes)
    assert {node.removeprefix(prefix) for node in found.joints.values()} == set(
        load_skeleton(name).joints.values()
    )


def test_there_is_a_family_for_every_map():
    assert sorted(FAMILIES) == list(shipped_skeletons())


def test_spellings_of_smpl():
    for spelling in (str.lower, str.upper, str.title, lambda name: name.title().replace("_", "")):
        bvh = family("smpl_words").hierarchy()
        bvh = renamed(bvh, {joint: spelling(joint) for joint in bvh.names})
        assert find_skeleton(bvh).name == "smpl_words"


def test_a_rest_pose_is_spelt_like_the_file():
    bvh = own_tree(load_skeleton("bandai_namco")).hierarchy()
    bvh = renamed(bvh, {joint: "ns:" + joint for joint in bvh.names})
    found = find_skeleton(bvh)
    assert isinstance(found.rest, dict)
    assert set(found.rest) <= set(bvh.names)
    assert find_skeleton(bvh, load_skeleton("bandai_namco")).joints == found.joints
