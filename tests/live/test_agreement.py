"""Twenty seconds of a stream: what a VMC receiver rebuilds, and the files of a recording, are its poses."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import tiny
import torch
import wearer
from glb import Glb
from plain_kinematics import bvh_positions
from vmc_receiver import Marionette, posed

from memmlp.live.outputs import VMC, Outputs, Receiver
from memmlp.live.recorder import Recorder
from memmlp.live.spaces import SPACES
from memmlp.live.stream import Stream
from memmlp.motion.body import JOINTS, N_JOINTS
from memmlp.motion.formats.npz import read_clip
from memmlp.motion.formats.vrm import UNITY_BONES as UNITY
from memmlp.motion.geometry import axis_angle_to_matrix, forward_kinematics

pytestmark = pytest.mark.slow

SECONDS, HEIGHT, FLOOR = 20, 1.86, 0.25
SIZE = HEIGHT / 1.72  # the wearer's over the built-in body's
MILLIMETRE = 1e-3


class Played(NamedTuple):
    """Joints (1200, 22, 3), metres, of the wearer above the floor, and the files of the recording.

    The joints are those of the poses, in OpenXR's axes, and as they were received, in Unity's.
    """

    poses: np.ndarray
    received: np.ndarray
    files: dict[str, Path]


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory, step_files: Callable[[str], Path]) -> Played:
    """Stream twenty seconds of a tall person's trackers, on a raised floor, as fast as it goes."""
    folder, space = tmp_path_factory.mktemp("played"), SPACES["openxr"]
    person = wearer.person(np.arange(60 * SECONDS) / 60)
    stream, shown = (
        Stream(step_files("no_memory"), space="openxr", height=HEIGHT, floor=FLOOR) for _ in range(2)
    )
    marionette = Marionette()
    files = {kind: folder / f"played.{kind}" for kind in ("npz", "bvh", "glb")}
    recording = Recorder(list(files.values()), stream.network.body.rest, stream.network.fps, lambda _: None)
    outputs = Outputs([VMC(Receiver("127.0.0.1", marionette.port, "--vmc")), recording], pytest.fail)
    positions = space.positions_out(person.positions * SIZE + [0, 0, FLOOR])
    rotations = space.rotations_out(person.rotations)
    poses, received = [], []
    for index in range(60 * SECONDS):
        trackers = list(zip(positions[index], rotations[index], strict=True))
        outputs.take(stream.step_body(*trackers, time=index / 60))
        pose = shown.step(*trackers, time=index / 60)
        marionette.receive(), marionette.receive()
        poses.append(pose.positions - [0, FLOOR, 0])
        received.append([marionette.root, *(marionette.bones[name] for name in UNITY)])
    assert marionette.time == pytest.approx(SECONDS - 1 / 60, abs=1e-3)
    marionette.close()
    outputs.close()
    root, *bones = np.array(received).swapaxes(0, 1)
    at = posed(root, dict(zip(UNITY, bones, strict=True)))
    return Played(np.array(poses), np.stack([at[name] for name in UNITY], 1), files)


def test_a_vmc_receiver_rebuilds_every_joint(played: Played):
    assert np.ptp(played.poses, 0).max() > 1
    bone = played.poses[:, JOINTS.index("left_knee")] - played.poses[:, JOINTS.index("left_ankle")]
    np.testing.assert_allclose(np.linalg.norm(bone, axis=1), SIZE * np.hypot(0.42, 0.03), atol=1e-5)
    expected = played.poses * [1, 1, -1]  # OpenXR's z is Unity's -z
    assert apart(played.received, expected) < MILLIMETRE


def apart(ours: np.ndarray, theirs: np.ndarray) -> float:
    assert ours.shape == theirs.shape
    return np.linalg.norm(ours - theirs, axis=-1).max()


def test_recorded_files_hold_the_same_joints(played: Played):
    found = bvh_positions(played.files["bvh"])
    assert apart(np.stack([found[name] for name in JOINTS], 1) / 100, played.poses) < MILLIMETRE

    glb = Glb(played.files["glb"])
    times, _ = glb.channels()["pelvis", "rotation"]
    np.testing.assert_allclose(times, np.arange(60 * SECONDS) / 60, atol=1e-4)
    for frame in range(0, 60 * SECONDS, 97):
        world = glb.matrices(frame)
        assert apart(np.stack([world[name][:3, 3] for name in JOINTS]), played.poses[frame]) < MILLIMETRE

    clip = read_clip(played.files["npz"], "played")  # on a body of the network's size
    assert (len(clip), clip.fps) == (60 * SECONDS, 60)
    local = axis_angle_to_matrix(torch.tensor(clip.poses, dtype=torch.float64))
    root = torch.tensor(clip.trans, dtype=torch.float64) + tiny.REST[0]
    joints = forward_kinematics(local, root, tiny.REST)[1].numpy().reshape(-1, N_JOINTS, 3)
    assert apart(joints, SPACES["openxr"].positions_in(played.poses) / SIZE) < MILLIMETRE
