"""Outputs of a live body: bones by the VMC protocol, trackers for VRChat, both over OSC, and recorded files.

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

**Recordings**: all files of a recorder contain the same frames. Formats with a skeleton (BVH, glTF) have the
wearer's height. An npz does not have a body, and its readers use one of the network's size, so it holds the
motion of the network's body. Missing frames between two poses are interpolated. Breaks, after which the
network restarted, are left out of the files, and reported.
"""

from __future__ import annotations

import errno
import socket
import warnings
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from memmlp.common.errors import InputError
from memmlp.live.rotations import matrix_to_quaternion, slerp
from memmlp.live.spaces import SPACES
from memmlp.live.stream import BodyFrame
from memmlp.motion.body import JOINTS, N_JOINTS, PARENTS, ROOT
from memmlp.motion.clip import Clip
from memmlp.motion.exporting import format_of, write_motion
from memmlp.motion.formats.gltf import UNITY_BONES

VMC_PORT, VRCHAT_PORT = 39539, 9000
SPACE = SPACES["unity"]
HALF = 14  # messages of the first datagram; an Ethernet packet holds either half
LOADED, CALIBRATED, NORMAL = 1, 3, 0
LONGEST = 1.0  # seconds without a frame that a recording fills
FIXED_ROOT = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)  # position and quaternion
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
        name: the output's description.
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
        report: gets a line about each output that fails.
    """

    def __init__(self, outputs: Sequence[Output], report: Callable[[str], None]):
        self.outputs, self.report = outputs, report
        self.failed: set[str] = set()

    def take(self, frame: BodyFrame) -> None:
        """Give a frame to all outputs."""
        for output in self.outputs:
            try:
                output.take(frame)
            except OSError as error:
                if output.name not in self.failed:
                    self.failed.add(output.name)
                    self.report(f"{output.name}: {error.strerror or error}; the others continue")

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


def encode_osc(messages: Iterable[tuple[str, str, Iterable[Any]]]) -> bytes:
    """Return an OSC bundle of messages: each has an address, a letter of OSC for each argument, and these."""
    from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
    from pythonosc.osc_message_builder import OscMessageBuilder

    bundle = OscBundleBuilder(IMMEDIATELY)
    for address, kinds, arguments in messages:
        message = OscMessageBuilder(address)
        for kind, argument in zip(kinds, arguments, strict=True):
            message.add_arg(argument, kind)
        bundle.add_content(message.build())
    return bundle.build().dgram


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

    def take(self, frame: BodyFrame) -> None:
        """Send the frame's bones, in two datagrams."""
        self.start = frame.time if self.start is None else self.start
        values = np.empty((N_JOINTS, 7))  # each bone's position, metres, and quaternion in its parent's frame
        values[:, :3] = (frame.rest - frame.rest[list(PARENTS)]) * SPACE.body
        values[ROOT, :3] = SPACE.positions_out(frame.positions[ROOT])
        values[:, 3:] = matrix_to_quaternion(SPACE.pose_out(frame.local))
        messages: list[tuple[str, str, Iterable[Any]]] = [
            ("/VMC/Ext/OK", "iii", [LOADED, CALIBRATED, NORMAL]),
            ("/VMC/Ext/T", "f", [frame.time - self.start]),
            ("/VMC/Ext/Root/Pos", "sfffffff", ["root", *FIXED_ROOT]),
        ]
        for name, bone in zip(UNITY_BONES, values.tolist(), strict=True):
            messages.append(("/VMC/Ext/Bone/Pos", "sfffffff", [name, *bone]))
        self.receiver.send(encode_osc(messages[:HALF]))
        self.receiver.send(encode_osc(messages[HALF:]))


class VRChat:
    """An output that sends trackers to VRChat at a receiver."""

    def __init__(self, receiver: Receiver):
        self.name = f"VRChat at {receiver}"
        self.receiver, self.close = receiver, receiver.close

    def take(self, frame: BodyFrame) -> None:
        """Send the frame's trackers, in one datagram."""
        parts = [f"/tracking/trackers/{name}/{part}" for name in NAMES for part in ("position", "rotation")]
        vectors = place_trackers(frame).reshape(-1, 3).tolist()
        self.receiver.send(
            encode_osc((part, "fff", vector) for part, vector in zip(parts, vectors, strict=True))
        )


def place_trackers(frame: BodyFrame) -> np.ndarray:
    """Return position (metres) and Euler angles (degrees) of trackers and head (9, 2, 3), in Unity's axes."""
    turned = np.array(frame.local, np.float64)
    for joint in range(1, N_JOINTS):
        turned[joint] = turned[PARENTS[joint]] @ turned[joint]
    positions = SPACE.positions_out(frame.positions[AT])
    return np.stack([positions, euler_degrees(SPACE.rotations_out(turned[TURNS_WITH]))], 1)


def euler_degrees(rotations: np.ndarray) -> np.ndarray:
    """Return Unity's angles (n, 3) about X, Y and Z, degrees, with Ry Rx Rz = rotations (n, 3, 3)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # in gimbal lock one of two angles is free
        angles: np.ndarray = Rotation.from_matrix(rotations).as_euler("YXZ", degrees=True)[:, [1, 0, 2]]
    return angles


class Recorder:
    """An output that keeps frames, and writes files of the wearer's motion at the end.

    Args:
        paths: the files; their suffixes determine the formats.
        rest: the network's joints in the rest pose (22, 3), metres, SMPL's body frame.
        fps: the network's frames per second.
        report: gets a line about each file that was written, and about breaks.

    Raises:
        InputError: for other suffixes, a file that exists, or a folder that cannot be written.
    """

    def __init__(self, paths: Sequence[Path], rest: np.ndarray, fps: float, report: Callable[[str], None]):
        for path in paths:
            format_of(path, "--record")
            if path.exists():
                raise InputError(f"--record {path}: already exists; expected a new file")
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise InputError(f"--record {path}: cannot be written ({error.strerror})") from None
        if len({path.resolve() for path in paths}) < len(paths):
            raise InputError("--record: the same file twice; expected different files")
        self.name = "recording " + ", ".join(path.name for path in paths)
        self.paths, self.rest, self.fps, self.report = paths, rest, fps, report
        self.rows: list[np.ndarray] = []  # rotation vectors and the root's position (69,) of each frame
        self.filled, self.breaks, self.scale = 0, 0, 1.0
        self.last: tuple[float, np.ndarray, np.ndarray] | None = None

    def take(self, frame: BodyFrame) -> None:
        """Keep a frame, after interpolated frames for those that are missing before it."""
        root = frame.scale * frame.positions[ROOT]  # in the network's body size
        if self.last is not None:
            time, local, last_root = self.last
            steps = round((frame.time - time) * self.fps)
            if frame.restarted or not 0 < steps <= LONGEST * self.fps:
                self.breaks += 1
                steps = 1
            for weight in (step / steps for step in range(1, steps)):
                self._keep(slerp(local, frame.local, weight), last_root + weight * (root - last_root))
                self.filled += 1
        self._keep(frame.local, root)
        self.last, self.scale = (frame.time, frame.local, root), frame.scale

    def _keep(self, local: np.ndarray, root: np.ndarray) -> None:
        self.rows.append(np.concatenate([Rotation.from_matrix(local).as_rotvec().ravel(), root]).astype("f4"))

    def close(self) -> None:
        """Write the files.

        Raises:
            InputError: if a file can't be written; the other files are written all the same.
        """
        if not self.rows:
            self.report("recording: no frame arrived; nothing is written")
            return
        errors, rows = [], np.stack(self.rows)
        for path in self.paths:
            try:
                self._write(path, rows)
            except InputError as error:
                errors.append(error)
        if errors:
            raise errors[0]

    def _write(self, path: Path, rows: np.ndarray) -> None:
        """Write a file, and report its length, breaks and interpolated frames."""
        chosen = format_of(path)
        scale = self.scale if chosen.has_bones else 1.0
        rest = self.rest / scale
        poses = rows[:, :-3].reshape(-1, N_JOINTS, 3)
        clip = Clip(path.stem, poses, rows[:, -3:] / scale - rest[ROOT], self.fps)
        write_motion(path, clip, rest, chosen)
        parts = [f"{path}: {len(clip) / self.fps:.1f} s"]
        if self.breaks:
            parts.append(f"{self.breaks} break{'s' * (self.breaks > 1)} left out")
        if self.filled:
            parts.append(f"{self.filled} of {len(rows)} frames interpolated")
        self.report(", ".join(parts))
