"""Several outputs: one that fails is told once, costs the others nothing, and is tried again."""

from __future__ import annotations

import errno

import numpy as np
import pytest
from wearer import body_frame

from memmlp.common.errors import InputError
from memmlp.live.outputs import Bundle, Message, Outputs, Receiver
from memmlp.motion.body import builtin_rest_joints

REST = builtin_rest_joints()
FRAME = body_frame(1.5, np.tile(np.eye(3), (22, 1, 1)), REST, REST)


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
        outputs.take(FRAME)
    with pytest.raises(InputError, match="not closed"):
        outputs.close()
    (line,) = told
    assert line.startswith("failing: Network is unreachable")
    assert (failing.tried, keeping.tried, failing.closed, keeping.closed) == (3, 3, 1, 1)


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


def test_an_unknown_host_is_one_line():
    with pytest.raises(InputError, match=r"--vmc nowhere\.invalid"):
        Receiver("nowhere.invalid", 39539, "--vmc")
