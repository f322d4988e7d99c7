"""Several outputs: one that fails is told once, costs the others nothing, and is tried again."""

from __future__ import annotations

import errno
from types import SimpleNamespace

import numpy as np
import pytest

from memmlp.common.errors import InputError
from memmlp.live.outputs.osc import Bundle, Message, Receiver
from memmlp.live.outputs.output import Outputs, body_frame
from memmlp.live.rotations import matrix_to_quaternion
from memmlp.live.spaces import SPACES
from memmlp.live.stream import Pose
from memmlp.live.wearer import Wearer
from memmlp.motion.body import builtin_rest_joints

RANDOM = np.random.default_rng(0)
TURNS = np.stack([np.linalg.qr(m)[0] for m in RANDOM.normal(size=(22, 3, 3))])
TURNS *= np.linalg.det(TURNS)[:, None, None]
WHERE = RANDOM.normal(size=(22, 3))


def stream(space: str = "amass"):
    """What outputs look at of a stream."""
    wearer = Wearer(1.86, 0.25, 0.9)
    return SimpleNamespace(space=SPACES[space], wearer=wearer, rest=builtin_rest_joints() / 0.9)


def pose(local: np.ndarray = TURNS, positions: np.ndarray = WHERE) -> Pose:
    return Pose(1.5, positions, local, positions, (), True, False)


class Failing:
    name = "failing"

    def __init__(self) -> None:
        self.tried = self.closed = 0

    def take(self, frame) -> None:
        self.tried += 1
        raise OSError(101, "Network is unreachable")

    def close(self) -> None:
        self.closed += 1
        raise InputError("failing: not closed")


class Keeping(Failing):
    name = "keeping"

    def take(self, frame) -> None:
        self.tried += 1

    def close(self) -> None:
        self.closed += 1


def test_one_that_fails_is_told_once_and_costs_the_others_nothing():
    told: list[str] = []
    failing, keeping = Failing(), Keeping()
    outputs = Outputs([failing, keeping], told.append)
    for _ in range(3):
        outputs.take(stream(), pose())
    with pytest.raises(InputError, match="not closed"):
        outputs.close()
    assert told == ["failing: Network is unreachable; the others go on"]
    assert (failing.tried, keeping.tried, failing.closed, keeping.closed) == (3, 3, 1, 1)


@pytest.mark.parametrize("name", SPACES)
def test_a_frame_is_the_same_in_every_space_and_format(name: str):
    space = SPACES[name]
    there = pose(space.pose_out(TURNS), space.positions_out(WHERE + np.array([0, 0, 0.25])))
    quaternions = there._replace(rotations=matrix_to_quaternion(there.rotations))
    for each in (there, quaternions):
        frame = body_frame(stream(name), each)
        np.testing.assert_allclose(frame.local, TURNS, atol=1e-9)
        np.testing.assert_allclose(frame.positions, WHERE, atol=1e-9)  # above the floor
    assert (frame.time, frame.scale, frame.restarted) == (1.5, 0.9, False)


def test_a_bundle_s_floats_are_where_they_belong():
    """Beside texts of every length, and integers."""
    from vmc_receiver import messages

    names = ["", "a", "ab", "abc", "abcd"]
    bundle = Bundle([Message(f"/{name}", (name, 7), index) for index, name in enumerate(names)])
    for values in (np.arange(10.0), -np.arange(10.0)):
        found = messages(bundle.write(values))
        assert [m.values[:2] for m in found] == [[name, 7] for name in names]
        assert [v for m in found for v in m.values[2:]] == values.tolist()


class Network:
    """A socket in a network in some state."""

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


def test_nothing_is_waited_for():
    receiver = Receiver("127.0.0.1", 39539, "--vmc")
    assert receiver.socket.getblocking() is False
    receiver.close()


def test_an_unknown_host_is_one_line():
    with pytest.raises(InputError, match=r"--vmc nowhere\.invalid: .*; allowed is HOST or HOST:PORT"):
        Receiver("nowhere.invalid", 39539, "--vmc")
