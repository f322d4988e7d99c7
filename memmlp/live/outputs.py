"""Outputs of a live body: bones by the VMC protocol, trackers for VRChat, both over OSC.

**VMC** (protocol.vmc.info/english), as VSeeFace, Warudo, EVMC4U and others receive it. Each frame has
`/VMC/Ext/OK` (version 2.5: loaded, calibrated, normal mode), `/VMC/Ext/T` (seconds since the beginning),
`/VMC/Ext/Root/Pos` and for each bone `/VMC/Ext/Bone/Pos` (name, position and quaternion xyzw in the parent's
frame). The frame of reference is Unity's. In the rest pose, a T-pose that faces +Z, all rotations are the
identity. The root stays at the origin, and all movement is in the hips, since not all programs apply the
root's.

**VRChat** (docs.vrchat.com/docs/osc-trackers): up to eight trackers and the head,
`/tracking/trackers/1/position` and so on, three floats each; metres of the real world and Euler angles in
degrees, applied in the order Z, X, Y, in Unity's frame of reference. VRChat assigns the trackers when the
wearer calibrates in its T-pose. It shifts all trackers so that the head is at its avatar's head bone, and
turns them to the head's heading.
"""

from __future__ import annotations

import errno
import socket
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from memmlp.common.errors import InputError
from memmlp.live.rotations import matrix_to_quaternion
from memmlp.live.spaces import SPACES
from memmlp.live.stream import BodyFrame
from memmlp.motion.body import JOINTS, N_JOINTS, PARENTS, ROOT
from memmlp.motion.formats.vrm import UNITY_BONES

WORD = 4  # bytes
HEADER = 16  # bytes of an OSC bundle before its first message
LARGEST = 1472  # bytes of a datagram that an Ethernet packet holds, so that none is split
VMC_PORT, VRCHAT_PORT = 39539, 9000
SPACE = SPACES["unity"]
HALF = N_JOINTS // 2  # bones of a bundle, so that it is one Ethernet packet
LOADED, CALIBRATED, NORMAL = 1, 3, 0
FIXED_ROOT = np.array([0.0, 0, 0, 0, 0, 0, 1])  # position and quaternion
# The joint where a tracker is, and the joint whose bone it turns with: a knee's with the thigh, an elbow's
# with the upper arm.
PLACES = (
    ("pelvis", "pelvis"), ("spine3", "spine3"), ("left_ankle", "left_ankle"), ("right_ankle", "right_ankle"),
    ("left_knee", "left_hip"), ("right_knee", "right_hip"),
    ("left_elbow", "left_shoulder"), ("right_elbow", "right_shoulder"), ("head", "head"),
)  # fmt: skip
AT, TURNS_WITH = ([JOINTS.index(pair[k]) for pair in PLACES] for k in (0, 1))
NAMES = (*map(str, range(1, len(PLACES))), "head")


class Output(Protocol):
    """Takes frames without ever waiting: each frame is taken at once, or dropped.

    Attributes:
        name: the output in words.
    """

    name: str

    def take(self, frame: BodyFrame) -> None:
        """Take a frame. Raises OSError if that fails."""

    def close(self) -> None:
        """Complete unfinished work, such as files."""


class Outputs:
    """Several outputs; one that fails is reported once, and tried again with the next frame.

    Args:
        outputs: the outputs.
        tell: gets a line about each output that fails.
    """

    def __init__(self, outputs: Sequence[Output], tell: Callable[[str], None]):
        self.outputs, self.tell = outputs, tell
        self.failed: set[str] = set()

    def take(self, frame: BodyFrame) -> None:
        """Give a frame to all outputs."""
        for output in self.outputs:
            try:
                output.take(frame)
            except OSError as error:
                if output.name not in self.failed:
                    self.failed.add(output.name)
                    self.tell(f"{output.name}: {error.strerror or error}; the others continue")

    def close(self) -> None:
        """Close all outputs, even if closing one of them fails; the first error is raised at the end."""
        errors = []
        for output in self.outputs:
            try:
                output.close()
            except Exception as error:
                errors.append(error)
        if errors:
            raise errors[0]


class Message(NamedTuple):
    """An OSC message whose last arguments are floats.

    Attributes:
        address: the message's OSC address.
        fixed: the arguments before the floats, each an integer or a text.
        floats: how many floats follow.
    """

    address: str
    fixed: Sequence[int | str] = ()
    floats: int = 0


class Bundle:
    """An OSC bundle with a fixed layout: python-osc lays it out once, then only its floats change.

    Every element of a bundle is at a multiple of four bytes (Open Sound Control 1.0), so its floats are
    elements of one array of big-endian float32.

    Args:
        messages: the messages; `write` takes their floats in this order.
    """

    def __init__(self, messages: Sequence[Message]):
        from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
        from pythonosc.osc_message_builder import OscMessageBuilder

        bundle, places, end = OscBundleBuilder(IMMEDIATELY), [], HEADER
        for message in messages:
            builder = OscMessageBuilder(message.address)
            for value in message.fixed:
                builder.add_arg(value, "i" if isinstance(value, int) else "s")
            for _ in range(message.floats):
                builder.add_arg(0.0, "f")
            built = builder.build()
            bundle.add_content(built)
            end += WORD + len(built.dgram)
            places.append(end // WORD - np.arange(message.floats, 0, -1))
        self.data = np.frombuffer(bytearray(bundle.build().dgram), ">f4")
        self.places = np.concatenate(places).astype(int)

    def write(self, values: np.ndarray) -> bytes:
        """Return the bundle's datagram with these floats."""
        self.data[self.places] = values
        return self.data.tobytes()


class Receiver:
    """A program that receives datagrams at an address; it need not be running.

    Args:
        host: the program's host name or address.
        port: its UDP port.
        key: the option by which the user named it.

    Raises:
        InputError: for an unknown host name.
    """

    def __init__(self, host: str, port: int, key: str):
        try:
            family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        except (OSError, UnicodeError) as error:
            reason = getattr(error, "strerror", None) or error
            raise InputError(f"{key} {host}: {reason}; expected HOST or HOST:PORT") from None
        self.address: tuple[Any, ...] = address
        self.socket = socket.socket(family, socket.SOCK_DGRAM)
        self.socket.setblocking(False)

    def __str__(self) -> str:
        return f"{self.address[0]}:{self.address[1]}"

    def send(self, datagram: bytes) -> None:
        """Send a datagram, or drop it if the network is busy.

        Raises OSError if the address can't be reached.
        """
        try:
            self.socket.sendto(datagram, self.address)
        except OSError as error:
            if error.errno not in (errno.EAGAIN, errno.ENOBUFS):
                raise

    def close(self) -> None:
        """Release the socket."""
        self.socket.close()


class VMC:
    """An output that sends bones by the VMC protocol to a receiver."""

    def __init__(self, receiver: Receiver):
        self.name = f"VMC to {receiver}"
        self.receiver, self.close = receiver, receiver.close
        self.start: float | None = None
        bones = [Message("/VMC/Ext/Bone/Pos", (name,), 7) for name in UNITY_BONES]
        status = [
            Message("/VMC/Ext/OK", (LOADED, CALIBRATED, NORMAL)),
            Message("/VMC/Ext/T", (), 1),
            Message("/VMC/Ext/Root/Pos", ("root",), 7),
        ]
        self.bundles = Bundle([*status, *bones[:HALF]]), Bundle(bones[HALF:])

    def take(self, frame: BodyFrame) -> None:
        """Send the frame's bones, in two datagrams."""
        self.start = frame.time if self.start is None else self.start
        values = np.empty((N_JOINTS, 7))  # each bone's position, metres, and quaternion in its parent's frame
        values[:, :3] = (frame.rest - frame.rest[list(PARENTS)]) * SPACE.body
        values[ROOT, :3] = SPACE.positions_out(frame.positions[ROOT])
        values[:, 3:] = matrix_to_quaternion(SPACE.pose_out(frame.local))
        first, second = self.bundles
        status = np.concatenate([[frame.time - self.start], FIXED_ROOT])
        self.receiver.send(first.write(np.concatenate([status, values[:HALF].ravel()])))
        self.receiver.send(second.write(values[HALF:].ravel()))


class VRChat:
    """An output that sends trackers to VRChat at a receiver."""

    def __init__(self, receiver: Receiver):
        self.name = f"VRChat at {receiver}"
        self.receiver, self.close = receiver, receiver.close
        parts = [f"/tracking/trackers/{name}/{part}" for name in NAMES for part in ("position", "rotation")]
        self.bundle = Bundle([Message(address, (), 3) for address in parts])

    def take(self, frame: BodyFrame) -> None:
        """Send the frame's trackers, in one datagram."""
        self.receiver.send(self.bundle.write(place_trackers(frame).ravel()))


def place_trackers(frame: BodyFrame) -> np.ndarray:
    """Return position (metres) and Euler angles (degrees) of trackers and head (9, 2, 3), in Unity's axes."""
    turned = np.array(frame.local, np.float64)
    for joint in range(1, N_JOINTS):
        turned[joint] = turned[PARENTS[joint]] @ turned[joint]
    positions = SPACE.positions_out(frame.positions[AT])
    return np.stack([positions, euler_degrees(SPACE.rotations_out(turned[TURNS_WITH]))], 1)


def euler_degrees(rotations: np.ndarray) -> np.ndarray:
    """Return Unity's angles (n, 3) about X, Y and Z, degrees, with Ry Rx Rz = rotations (n, 3, 3).

    The product is correct in gimbal lock, too, where the angle about X is a right angle.
    """
    y = np.arctan2(rotations[:, 0, 2], rotations[:, 2, 2])
    cosine, sine = np.cos(y)[:, None], np.sin(y)[:, None]
    first = cosine * rotations[:, 0] - sine * rotations[:, 2]  # rows of Ry^T R = Rx Rz
    third = sine * rotations[:, 0] + cosine * rotations[:, 2]
    x = np.arctan2(-rotations[:, 1, 2], third[:, 2])
    z = np.arctan2(-first[:, 1], first[:, 0])
    return np.degrees(np.stack([x, y, z], 1))
