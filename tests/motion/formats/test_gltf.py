"""glTF files, by an independent reading of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from glb import Glb

from memmlp.motion.body import JOINTS, PARENTS, builtin_rest_joints
from memmlp.motion.clip import Clip
from memmlp.motion.formats.gltf import mannequin, write_gltf
from memmlp.motion.geometry import axis_angle_to_matrix, forward_kinematics

REST = builtin_rest_joints()


def moving(frames: int = 40, fps: float = 60.0) -> Clip:
    """Make a clip whose joints turn by any angle, the root several times, as it goes some metres."""
    random = np.random.default_rng(4)
    axes = random.normal(size=(22, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    poses = np.linspace(-7, 7, frames)[:, None, None] * axes
    trans = np.linspace(0, 1, frames)[:, None] * [3.0, -2.0, 0.5] + [0.3, 0.2, 0.95]
    return Clip("some/walk \N{LATIN SMALL LETTER O WITH DIAERESIS}", poses, trans, fps)


def joints_y_up(clip: Clip) -> np.ndarray:
    """The joints (N, 22, 3) by our forward kinematics, in glTF's axes: x, z, -y."""
    local = axis_angle_to_matrix(torch.tensor(clip.poses))
    root = torch.tensor(clip.trans + REST[0])
    positions = forward_kinematics(local, root, torch.tensor(REST))[1].numpy()
    return positions[..., [0, 2, 1]] * [1, 1, -1]


@pytest.fixture(scope="module")
def clip() -> Clip:
    return moving()


@pytest.fixture(scope="module")
def glb(clip: Clip, tmp_path_factory: pytest.TempPathFactory) -> Glb:
    path = tmp_path_factory.mktemp("gltf") / "clip.glb"
    write_gltf(path, clip, REST)
    return Glb(path)


def test_the_nodes_are_where_our_joints_are(glb: Glb, clip: Clip):
    expected = joints_y_up(clip)
    for frame in range(len(clip)):
        world = glb.matrices(frame)
        found = np.stack([world[joint][:3, 3] for joint in JOINTS])
        assert np.linalg.norm(found - expected[frame], axis=1).max() < 1e-5


def test_the_tree_is_ours(glb: Glb):
    nodes = glb.json["nodes"]
    assert tuple(node["name"] for node in nodes[:22]) == JOINTS
    for joint, parent in enumerate(PARENTS):
        above = [index for index, node in enumerate(nodes) if joint in node.get("children", ())]
        assert above == ([parent] if joint else [])


def test_times_are_exact(glb: Glb, clip: Clip):
    for times, values in glb.channels().values():
        np.testing.assert_array_equal(times, (np.arange(len(clip)) / 60).astype(np.float32))
        assert len(values) == len(times)
    assert len(glb.channels()) == 23


def test_quaternions_are_unit_and_keep_their_sign(glb: Glb):
    for (_, path), (_, values) in glb.channels().items():
        if path == "rotation":
            np.testing.assert_allclose(np.linalg.norm(values, axis=1), 1, atol=1e-6)
            assert (values[1:] * values[:-1]).sum(1).min() > 0.9


def test_the_bind_pose_stands_on_the_floor(glb: Glb):
    world = glb.matrices(None)
    joints = np.stack([world[joint][:3, 3] for joint in JOINTS])
    np.testing.assert_allclose(joints - joints[0], REST - REST[0], atol=1e-6)
    assert joints[:, 1].min() == pytest.approx(0, abs=1e-6)
    positions = glb.json["meshes"][0]["primitives"][0]["attributes"]["POSITION"]
    np.testing.assert_allclose(glb.vertices(None), glb.array(positions), atol=1e-6)


def test_the_mannequin_moves_with_the_joints(glb: Glb, clip: Clip):
    """Each vertex is as far from its joint as in the bind pose; head and hands follow their own joints."""
    attributes = glb.json["meshes"][0]["primitives"][0]["attributes"]
    owner = glb.array(attributes["JOINTS_0"])[:, 0]
    assert set(owner) == set(range(22)) - {JOINTS.index("left_foot"), JOINTS.index("right_foot")}
    still = np.stack([glb.matrices(None)[joint][:3, 3] for joint in JOINTS])[owner]
    reach = np.linalg.norm(glb.array(attributes["POSITION"]) - still, axis=1)
    for frame in (0, 17, len(clip) - 1):
        moved = joints_y_up(clip)[frame][owner]
        np.testing.assert_allclose(np.linalg.norm(glb.vertices(frame) - moved, axis=1), reach, atol=1e-5)


def test_the_mannequin_is_seen_from_outside():
    mesh = mannequin(REST)
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-12)
    a, b, c = (mesh.positions[mesh.triangles[:, corner]] for corner in range(3))
    across = np.cross(b - a, c - a)
    real = np.linalg.norm(across, axis=1) > 1e-9  # a limb's ends are points
    assert real.mean() > 0.8
    assert (across * mesh.normals[mesh.triangles].mean(1)).sum(1)[real].min() > 0
    assert np.ptp(mesh.positions, axis=0) == pytest.approx([1.66, 1.77, 0.27], abs=0.02)  # a T-pose


def test_names_and_bounds_are_what_viewers_need(glb: Glb, clip: Clip):
    assert glb.json["asset"]["version"] == "2.0"
    assert glb.json["animations"][0]["name"] == clip.name
    primitive = glb.json["meshes"][0]["primitives"][0]
    accessors = glb.json["accessors"]
    assert "min" in accessors[primitive["attributes"]["POSITION"]]
    assert "min" in accessors[glb.json["animations"][0]["samplers"][0]["input"]]
    indices = glb.array(primitive["indices"])
    assert indices.max() < accessors[primitive["attributes"]["POSITION"]]["count"]
    assert glb.json["nodes"][glb.json["scenes"][0]["nodes"][1]] == {"name": "mannequin", "mesh": 0, "skin": 0}


def test_one_frame_and_another_rate(tmp_path: Path):
    write_gltf(tmp_path / "one.glb", moving(1), REST)
    assert Glb(tmp_path / "one.glb").channels()["pelvis", "rotation"][0].tolist() == [0]
    write_gltf(tmp_path / "slow.glb", moving(4, 29.97), REST)
    times = Glb(tmp_path / "slow.glb").channels()["head", "rotation"][0]
    np.testing.assert_array_equal(times, (np.arange(4) / 29.97).astype(np.float32))
