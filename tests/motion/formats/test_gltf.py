"""glTF and VRM files, by an independent reading of them."""

from pathlib import Path

import numpy as np
import pytest
from glb import Glb

from memmlp.motion.body import JOINTS, PARENTS, make_builtin_rest_joints
from memmlp.motion.clip import Clip
from memmlp.motion.formats.gltf import UNITY_BONES, encode_vrm, write_gltf
from memmlp.motion.geometry import compute_clip_kinematics

REST = make_builtin_rest_joints()


def moving(frames: int = 40) -> Clip:
    """Make a clip whose joints turn by any angle, the root several times, as it goes some metres."""
    axes = np.random.default_rng(4).normal(size=(22, 3))
    poses = np.linspace(-7, 7, frames)[:, None, None] * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    trans = np.linspace(0, 1, frames)[:, None] * [3.0, -2.0, 0.5] + [0.3, 0.2, 0.95]
    return Clip("some/walk \N{LATIN SMALL LETTER O WITH DIAERESIS}", poses, trans, 60.0)


CLIP = moving()
JOINTS_Y_UP = compute_clip_kinematics(CLIP, REST)[1][..., [0, 2, 1]] * [1, 1, -1]
"""The joints (N, 22, 3) by our forward kinematics, in glTF's axes."""


@pytest.fixture(scope="module")
def glb(tmp_path_factory: pytest.TempPathFactory) -> Glb:
    path = tmp_path_factory.mktemp("gltf") / "clip.glb"
    write_gltf(path, CLIP, REST)
    return Glb(path)


def test_nodes_have_our_tree_and_are_where_our_joints_are(glb: Glb):
    nodes = glb.json["nodes"]
    assert tuple(node["name"] for node in nodes[:22]) == JOINTS
    for joint, parent in enumerate(PARENTS):
        above = [index for index, node in enumerate(nodes) if joint in node.get("children", ())]
        assert above == ([parent] if joint else [])
    for frame in range(0, len(CLIP), 3):
        world = glb.matrices(frame)
        found = np.stack([world[joint][:3, 3] for joint in JOINTS])
        assert np.linalg.norm(found - JOINTS_Y_UP[frame], axis=1).max() < 1e-5
    assert glb.json["animations"][0]["name"] == CLIP.name


def test_times_are_exact_and_quaternions_keep_their_sign(glb: Glb, tmp_path: Path):
    assert len(glb.channels()) == 23
    for (_, path), (times, values) in glb.channels().items():
        np.testing.assert_array_equal(times, (np.arange(len(CLIP)) / 60).astype(np.float32))
        if path == "rotation":
            np.testing.assert_allclose(np.linalg.norm(values, axis=1), 1, atol=1e-6)
            assert (values[1:] * values[:-1]).sum(1).min() > 0.9
    write_gltf(tmp_path / "one.glb", moving(1), REST)
    assert Glb(tmp_path / "one.glb").channels()["pelvis", "rotation"][0].tolist() == [0]


def test_the_mannequin_moves_with_the_joints(glb: Glb):
    """Each vertex is as far from its joint as in the bind pose; head and hands follow their own joints."""
    attributes = glb.json["meshes"][0]["primitives"][0]["attributes"]
    owner = glb.array(attributes["JOINTS_0"])[:, 0]
    assert set(owner) == set(range(22)) - {JOINTS.index("left_foot"), JOINTS.index("right_foot")}
    still = np.stack([glb.matrices(None)[joint][:3, 3] for joint in JOINTS])[owner]
    away = glb.array(attributes["POSITION"]) - still
    assert ((away * glb.array(attributes["NORMAL"])).sum(1) > 0).mean() > 0.95  # normals are outward
    reach = np.linalg.norm(away, axis=1)
    for frame in (0, 17, len(CLIP) - 1):
        moved = JOINTS_Y_UP[frame][owner]
        np.testing.assert_allclose(np.linalg.norm(glb.vertices(frame) - moved, axis=1), reach, atol=1e-5)


REQUIRED = {
    "hips", "spine", "head", "leftUpperLeg", "leftLowerLeg", "leftFoot", "rightUpperLeg", "rightLowerLeg",
    "rightFoot", "leftUpperArm", "leftLowerArm", "leftHand", "rightUpperArm", "rightLowerArm", "rightHand",
}  # fmt: skip


def test_the_avatar_is_a_humanoid_of_22_bones_that_anybody_may_use(tmp_path: Path):
    (tmp_path / "mannequin.vrm").write_bytes(encode_vrm(REST))
    avatar = Glb(tmp_path / "mannequin.vrm")
    extension = avatar.json["extensions"]["VRMC_vrm"]
    assert (avatar.json["extensionsUsed"], extension["specVersion"]) == (["VRMC_vrm"], "1.0")
    nodes, bones = avatar.json["nodes"], extension["humanoid"]["humanBones"]
    named = {bone: nodes[about["node"]]["name"] for bone, about in bones.items()}
    assert set(named) >= REQUIRED
    assert len(set(named.values())) == len(JOINTS)
    expected = {
        "hips": "pelvis", "leftHand": "left_wrist", "rightToes": "right_foot", "upperChest": "spine3",
        "leftUpperLeg": "left_hip", "rightShoulder": "right_collar", "rightUpperArm": "right_shoulder",
    }  # fmt: skip
    assert {bone: named[bone] for bone in expected} == expected
    assert [name.lower() for name in UNITY_BONES] == [name.lower() for name in named]
    joints = np.stack([avatar.matrices(None)[name][:3, 3] for name in JOINTS])
    np.testing.assert_allclose(joints, REST - [0, REST[:, 1].min(), 0], atol=1e-6)
    eyes = avatar.json["meshes"][0]["primitives"][1]["attributes"]["POSITION"]
    assert avatar.array(eyes)[:, 2].min() > joints[JOINTS.index("head"), 2]
    assert all(node.get("rotation", [0, 0, 0, 1]) == [0, 0, 0, 1] for node in nodes)
    meta = extension["meta"]
    assert meta["licenseUrl"] == "https://vrm.dev/licenses/1.0/"  # which VRM demands of all
    assert (meta["avatarPermission"], meta["modification"]) == ("everyone", "allowModificationRedistribution")
