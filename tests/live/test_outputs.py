"""Outputs: one that fails costs the others nothing; VMC and VRChat by their specifications."""

from __future__ import annotations

import errno
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from vmc_receiver import TREE, Marionette, messages
from wearer import body_frame

from memmlp.common.errors import InputError
from memmlp.live.outputs import (
    LARGEST,
    VMC,
    Bundle,
    Message,
    Outputs,
    Receiver,
    VRChat,
    euler_degrees,
    place_trackers,
)
from memmlp.live.stream import BodyFrame
from memmlp.motion.body import JOINTS, builtin_rest_joints

REST = builtin_rest_joints()
FRAME = body_frame(1.5, np.tile(np.eye(3), (22, 1, 1)), REST, REST)


class Output:
    def __init__(self, name: str, failing: bool) -> None:
        self.name, self.failing = name, failing
        self.frames = self.closed = 0

    def take(self, frame) -> None:
        self.frames += 1
        if self.failing:
            raise OSError(101, "Network is unreachable")

    def close(self) -> None:
        self.closed += 1
        raise InputError(f"{self.name}: not closed")


def test_one_that_fails_is_told_once_and_costs_the_others_nothing():
    told: list[str] = []
    failing, keeping = Output("failing", True), Output("keeping", False)
    outputs = Outputs([failing, keeping], told.append)
    for _ in range(3):
        outputs.take(FRAME)
    with pytest.raises(InputError, match="not closed"):
        outputs.close()
    (line,) = told
    assert line.startswith("failing: Network is unreachable")
    assert (failing.frames, keeping.frames, failing.closed, keeping.closed) == (3, 3, 1, 1)


def test_a_bundle_s_floats_are_where_they_belong():
    """Beside texts of every length, and integers."""
    names = ["", "a", "ab", "abc", "abcd"]
    bundle = Bundle([Message(f"/{name}", (name, 7), index) for index, name in enumerate(names)])
    for values in (np.arange(10.0), -np.arange(10.0)):
        found = messages(bundle.write(values))
        assert [m.values[:2] for m in found] == [[name, 7] for name in names]
        assert [v for m in found for v in m.values[2:]] == values.tolist()


class Network:
    def __init__(self, state: int):
        self.state = state

    def sendto(self, *_: object) -> None:
        raise OSError(self.state, "as it is")

    def close(self) -> None: ...


def test_a_busy_network_drops_a_datagram_and_no_way_is_an_error():
    receiver = Receiver("127.0.0.1", 39539, "--vmc")
    receiver.close()
    for state in (errno.EAGAIN, errno.ENOBUFS):
        receiver.socket = Network(state)
        receiver.send(b"")
    receiver.socket = Network(errno.ENETUNREACH)
    with pytest.raises(OSError, match="as it is"):
        receiver.send(b"")


# VMC


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


def test_a_person_along_unity_s_z_with_hanging_arms_and_a_bent_knee(vmc: VMC, marionette: Marionette):
    """Left and right, front and back: each is one-sided."""
    local = np.tile(np.eye(3), (22, 1, 1))
    local[0] = AROUND
    sent(vmc, marionette, frame(local))
    assert np.abs(marionette.bones["Hips"][3:]) == pytest.approx([0, 0, 0, 1], abs=1e-6)
    assert marionette.positions()["LeftHand"][0] == pytest.approx(-0.71)
    assert marionette.positions()["LeftToes"][2] == pytest.approx(0.095)
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


# VRChat


AROUND = Rotation.from_euler("y", 180, degrees=True).as_matrix()  # so that the person looks along Unity's +Z


def of_axis(axis: int, degrees: float) -> np.ndarray:
    """Unity's turn about one of its axes, as a matrix on its coordinates."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    turn[i, i], turn[j, j], turn[i, j], turn[j, i] = c, c, -s, s
    return turn


ANGLE = st.sampled_from([0.0, 90.0, -90.0, 180.0]) | st.floats(-180, 180)


@given(ANGLE, ANGLE, ANGLE)
@example(90.0, 30.0, 20.0)
@example(-90.0, 30.0, 20.0)
def test_angles_are_applied_about_z_then_x_then_y(x: float, y: float, z: float):
    wanted = of_axis(1, y) @ of_axis(0, x) @ of_axis(2, z)
    again = euler_degrees(wanted[None])[0]
    made = of_axis(1, again[1]) @ of_axis(0, again[0]) @ of_axis(2, again[2])
    np.testing.assert_allclose(made, wanted, atol=1e-6)


def standing(**turns: np.ndarray) -> BodyFrame:
    """A person who looks along Unity's +Z, some joints turned; joints' positions count their index."""
    local = np.tile(np.eye(3), (22, 1, 1))
    for name, turn in turns.items():
        local[JOINTS.index(name)] = turn
    local[0] = UPRIGHT @ AROUND @ local[0]
    positions = np.arange(22.0)[:, None] * [1, 10, 100]
    return body_frame(0.0, local, positions, REST)


def test_where_the_trackers_are_and_how_they_turn():
    """A thigh that is lifted turns the knee's tracker; the shank does not."""
    lifted, bent = (Rotation.from_euler("x", angle, degrees=True).as_matrix() for angle in (-60, 80))
    right = Rotation.from_euler("y", -30, degrees=True).as_matrix()  # SMPL's Y is up, its right -X
    found = place_trackers(standing(left_hip=lifted, left_knee=bent, head=right))
    lower = ("left_ankle", "right_ankle", "left_knee", "right_knee")
    names = ["pelvis", "spine3", *lower, "left_elbow", "right_elbow", "head"]
    index = np.array([JOINTS.index(name) for name in names], float)
    np.testing.assert_allclose(found[:, 0], index[:, None] * [1, 100, 10])  # Unity's y is AMASS' z
    angles = dict(zip(names, found[:, 1], strict=True))
    assert angles["left_knee"] == pytest.approx([-60, 0, 0], abs=1e-6)  # Unity's positive X looks down
    assert angles["left_ankle"] == pytest.approx([20, 0, 0], abs=1e-6)
    assert angles["head"] == pytest.approx([0, 30, 0], abs=1e-6)  # clockwise, seen from above


def test_the_datagram():
    receiver = Marionette()
    sender = VRChat(Receiver("127.0.0.1", receiver.port, "--vrchat"))
    frame = standing()
    sender.take(frame)
    found = receiver.receive()
    sender.close()
    receiver.close()
    names = [*map(str, range(1, 9)), "head"]
    expected = [f"/tracking/trackers/{name}/{part}" for name in names for part in ("position", "rotation")]
    assert [m.address for m in found] == expected
    assert {m.types for m in found} == {",fff"}
    values = np.array([m.values for m in found])
    np.testing.assert_allclose(values, place_trackers(frame).reshape(-1, 3), atol=1e-4)
