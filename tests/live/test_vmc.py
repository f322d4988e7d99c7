"""The VMC protocol, by a receiver that was written from its specification."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from vmc_receiver import TREE, Marionette
from wearer import body_frame

from memmlp.live.outputs import LARGEST, VMC, Receiver
from memmlp.live.stream import BodyFrame
from memmlp.motion.body import JOINTS, builtin_rest_joints

REST = builtin_rest_joints()
UPRIGHT = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # of a person in AMASS' world who looks along -Y


def frame(
    local: np.ndarray | None = None, root: tuple[float, ...] = (0, 0, 0.98), time: float = 5.0
) -> BodyFrame:
    """A frame of a body, whose joints but the root are not needed; upright in T-pose by default."""
    turns = np.tile(np.eye(3), (22, 1, 1)) if local is None else local.copy()
    turns[0] = UPRIGHT @ turns[0]
    return body_frame(time, turns, np.tile(np.array(root), (22, 1)), REST)


@pytest.fixture
def marionette() -> Iterator[Marionette]:
    receiver = Marionette()
    yield receiver
    receiver.close()


@pytest.fixture
def vmc(marionette: Marionette) -> Iterator[VMC]:
    sender = VMC(Receiver("127.0.0.1", marionette.port, "--vmc"))
    yield sender
    sender.close()


def sent(vmc: VMC, marionette: Marionette, each: BodyFrame) -> list:
    vmc.take(each)
    return marionette.receive() + marionette.receive()


def test_a_t_pose_is_the_identity_and_stands_on_the_floor(vmc: VMC, marionette: Marionette):
    """Who looks along AMASS' -Y looks along Unity's -Z: the hips are turned by half, all else by nothing."""
    found = sent(vmc, marionette, frame())
    assert [m.address for m in found].count("/VMC/Ext/Bone/Pos") == 22
    assert [m.address for m in found][:3] == ["/VMC/Ext/OK", "/VMC/Ext/T", "/VMC/Ext/Root/Pos"]
    assert found[0].values == [1, 3, 0]
    assert set(marionette.bones) == set(TREE)
    turns = {name: bone[3:] for name, bone in marionette.bones.items()}
    assert np.abs(turns.pop("Hips")) == pytest.approx([0, 1, 0, 0], abs=1e-6)
    assert np.array(list(turns.values())) == pytest.approx(np.tile([0, 0, 0, 1.0], (21, 1)), abs=1e-6)
    at = marionette.positions()
    assert at["Head"] == pytest.approx([0, 0.98 + 0.59, -0.01], abs=1e-6)
    assert at["LeftHand"][0] == pytest.approx(
        0.71
    )  # whose left is Unity's +X, since the person looks along -Z
    assert at["LeftToes"] == pytest.approx([0.115, 0, -0.095], abs=1e-6)


def test_who_looks_along_unity_s_z_has_the_left_at_minus_x(vmc: VMC, marionette: Marionette):
    local = np.tile(np.eye(3), (22, 1, 1))
    local[0] = Rotation.from_euler("y", 180, degrees=True).as_matrix()
    sent(vmc, marionette, frame(local))
    assert np.abs(marionette.bones["Hips"][3:]) == pytest.approx([0, 0, 0, 1], abs=1e-6)
    assert marionette.positions()["LeftHand"][0] == pytest.approx(-0.71)
    assert marionette.positions()["LeftToes"][2] == pytest.approx(0.095)


def test_arms_that_hang_and_a_knee_that_bends(vmc: VMC, marionette: Marionette):
    """Against left and right, and front and back: each is one-sided."""
    local = np.tile(np.eye(3), (22, 1, 1))
    local[0] = Rotation.from_euler("y", 180, degrees=True).as_matrix()
    local[JOINTS.index("left_shoulder")] = Rotation.from_euler("z", -90, degrees=True).as_matrix()
    local[JOINTS.index("right_knee")] = Rotation.from_euler("x", 90, degrees=True).as_matrix()
    sent(vmc, marionette, frame(local))
    at = marionette.positions()
    assert at["LeftHand"] - at["LeftUpperArm"] == pytest.approx([0.005, -0.53, -0.015], abs=1e-5)
    assert at["RightFoot"] - at["RightLowerLeg"] == pytest.approx([0, 0.03, -0.42], abs=1e-5)


def test_time_begins_at_zero_and_packets_are_whole(vmc: VMC, marionette: Marionette):
    for seconds in (5.0, 5.25):
        vmc.take(frame(time=seconds))
        first, second = (marionette.socket.recv(65_536) for _ in range(2))
        assert max(len(first), len(second)) <= LARGEST
    for data in (first, second):
        marionette.socket.sendto(data, ("127.0.0.1", marionette.port))
        marionette.receive()
    assert marionette.time == pytest.approx(0.25)
    assert marionette.loaded


def test_nobody_listening_costs_nothing(marionette: Marionette):
    port = marionette.port
    marionette.close()
    sender = VMC(Receiver("127.0.0.1", port, "--vmc"))
    for _ in range(3):
        sender.take(frame())
    sender.close()
