"""VRChat's trackers, by VRChat's description of them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from vmc_receiver import Marionette
from wearer import body_frame

from memmlp.live.outputs import Receiver, VRChat, euler_degrees, place_trackers
from memmlp.live.stream import BodyFrame
from memmlp.motion.body import JOINTS, builtin_rest_joints

REST = builtin_rest_joints()
UPRIGHT = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
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
    found = place_trackers(standing(left_hip=lifted, left_knee=bent))
    names = [
        "pelvis",
        "spine3",
        "left_ankle",
        "right_ankle",
        "left_knee",
        "right_knee",
        "left_elbow",
        "right_elbow",
        "head",
    ]
    index = np.array([JOINTS.index(name) for name in names], float)
    np.testing.assert_allclose(found[:, 0], index[:, None] * [1, 100, 10])  # Unity's y is AMASS' z
    angles = {name: angle for name, angle in zip(names, found[:, 1], strict=True)}
    assert angles["left_knee"] == pytest.approx([-60, 0, 0], abs=1e-6)  # Unity's positive X looks down
    assert angles["left_ankle"] == pytest.approx([20, 0, 0], abs=1e-6)
    assert angles["head"] == pytest.approx([0, 0, 0], abs=1e-6)


def test_a_head_that_looks_to_the_right_has_a_positive_y():
    """As Unity turns: clockwise, seen from above."""
    right = Rotation.from_euler("y", -30, degrees=True).as_matrix()  # SMPL's Y is up, its right -X
    assert place_trackers(standing(head=right))[8, 1] == pytest.approx([0, 30, 0], abs=1e-6)


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
