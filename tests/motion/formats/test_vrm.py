"""The project's own avatar, by an independent reading and by VRM 1.0's demands."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from glb import Glb

from memmlp.motion.body import JOINTS, builtin_rest_joints
from memmlp.motion.formats.gltf import UNITY_BONES as UNITY
from memmlp.motion.formats.gltf import VRM_BONES as VRM
from memmlp.motion.formats.gltf import write_vrm

REST = builtin_rest_joints()
REQUIRED = {
    "hips", "spine", "head", "leftUpperLeg", "leftLowerLeg", "leftFoot", "rightUpperLeg", "rightLowerLeg",
    "rightFoot", "leftUpperArm", "leftLowerArm", "leftHand", "rightUpperArm", "rightLowerArm", "rightHand",
}  # fmt: skip
PARENTS = {
    "spine": "hips", "chest": "spine", "upperChest": "chest", "neck": "upperChest", "head": "neck",
    "leftShoulder": "upperChest", "leftUpperArm": "leftShoulder", "leftLowerArm": "leftUpperArm",
    "leftHand": "leftLowerArm", "leftUpperLeg": "hips", "leftLowerLeg": "leftUpperLeg",
    "leftFoot": "leftLowerLeg", "leftToes": "leftFoot",
}  # fmt: skip


@pytest.fixture(scope="module")
def glb(tmp_path_factory: pytest.TempPathFactory) -> Glb:
    path = tmp_path_factory.mktemp("vrm") / "mannequin.vrm"
    write_vrm(path, REST)
    assert path.stat().st_size < 500_000
    return Glb(path)


def test_every_joint_is_a_bone_of_the_humanoid(glb: Glb):
    extension = glb.json["extensions"]["VRMC_vrm"]
    assert glb.json["extensionsUsed"] == ["VRMC_vrm"]
    assert extension["specVersion"] == "1.0"
    bones = {
        bone: glb.json["nodes"][about["node"]]["name"]
        for bone, about in extension["humanoid"]["humanBones"].items()
    }
    assert set(bones) >= REQUIRED
    assert len(set(bones.values())) == len(JOINTS)
    named = {
        "hips": "pelvis", "leftHand": "left_wrist", "rightToes": "right_foot", "upperChest": "spine3",
        "leftUpperLeg": "left_hip", "rightShoulder": "right_collar", "rightUpperArm": "right_shoulder",
    }  # fmt: skip
    assert {bone: bones[bone] for bone in named} == named


def test_the_bones_tree_is_the_humanoid_s(glb: Glb):
    above = {child: node["name"] for node in glb.json["nodes"] for child in node.get("children", ())}
    joint_of = dict(zip(VRM, JOINTS, strict=True))
    for bone, parent in PARENTS.items():
        assert above[JOINTS.index(joint_of[bone])] == joint_of[parent]
        right = bone.replace("left", "right"), parent.replace("left", "right")
        assert above[JOINTS.index(joint_of[right[0]])] == joint_of[right[1]]


def test_it_stands_in_t_pose_on_the_floor_and_looks_along_z(glb: Glb):
    joints = np.stack([glb.matrices(None)[name][:3, 3] for name in JOINTS])
    np.testing.assert_allclose(joints, REST - [0, REST[:, 1].min(), 0], atol=1e-6)
    assert joints[JOINTS.index("left_wrist"), 0] > 0.5
    eyes = glb.json["meshes"][0]["primitives"][1]["attributes"]["POSITION"]
    assert glb.array(eyes)[:, 2].min() > joints[JOINTS.index("head"), 2]
    assert all(node.get("rotation", [0, 0, 0, 1]) == [0, 0, 0, 1] for node in glb.json["nodes"])


def test_anybody_may_use_it(glb: Glb):
    meta = glb.json["extensions"]["VRMC_vrm"]["meta"]
    assert meta["licenseUrl"] == "https://vrm.dev/licenses/1.0/"  # which VRM demands of all
    assert meta["name"]
    assert meta["authors"]
    assert (meta["avatarPermission"], meta["modification"]) == ("everyone", "allowModificationRedistribution")


def test_unity_s_names_are_the_same_words():
    assert [name.lower() for name in UNITY] == [name.lower() for name in VRM]
    assert UNITY[0] == "Hips"


def test_nothing_half_written_is_left(tmp_path: Path):
    (tmp_path / "a.vrm").mkdir()
    with pytest.raises(OSError, match=r"a\.vrm"):
        write_vrm(tmp_path / "a.vrm", REST)
    assert [path.name for path in tmp_path.iterdir()] == ["a.vrm"]
