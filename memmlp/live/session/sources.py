"""Sources of tracker poses: a clip that is played, or packets that arrive at this machine.

One datagram is one sample, as JSON or as an OSC bundle. A pose is seven numbers, `x y z qx qy qz qw`: metres
and a unit quaternion. In JSON:

    {"time": 12.25, "seq": 735, "head": [x, y, z, qx, qy, qz, qw], "left": null, "right": [...]}

In OSC a bundle has the messages `/memmlp/head`, `/memmlp/left`, `/memmlp/right` (seven floats each),
`/memmlp/time` (a double or float) and `/memmlp/seq` (an integer).

A tracker that is null or missing is lost. A packet without a time gets its time of arrival. By the sample's
number, seq, missing packets are counted, and those that others have overtaken are left out.
"""

from __future__ import annotations

import errno
import json
import logging
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from ipaddress import IPv4Network, ip_address
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from memmlp.common.errors import InputError
from memmlp.common.page_server import EVERYWHERE, HOST
from memmlp.common.progress import notify
from memmlp.live.rotations import matrix_to_quaternion, sixd_to_matrix
from memmlp.live.spaces import SpaceName
from memmlp.live.tracker_resampling import TRACKERS, TrackerSample, interpolate
from memmlp.motion.body import (
    FPS,
    MOTION_DIM,
    N_JOINTS,
    POSITION,
    SPARSE_DIM,
    SPARSE_POSITION,
    SPARSE_ROTATION,
)

PREFIX = "/memmlp/"
POSE = 7  # numbers of a pose
REPORTED = 3  # other machines that are reported
WAIT = 0.25  # seconds that `read` waits at most
PAUSE = 1.0  # seconds between two rounds of a clip, so long that the stream restarts
LARGEST = 65_536  # the largest datagram, bytes
OVERTAKEN = 20  # packets that may overtake another; a number further back is a sender that restarted
RESTARTED = 10_000  # so many missing numbers are another sender, not lost packets

QuaternionPose = tuple[np.ndarray, np.ndarray] | None
"""A tracker's position (3,), metres, and quaternion xyzw (4,); None for a lost tracker."""
QuaternionPoses = tuple[QuaternionPose, QuaternionPose, QuaternionPose]
"""The poses of head, left and right."""


class Packet(NamedTuple):
    """One sample of the trackers.

    Attributes:
        trackers: head, left and right.
        time: seconds of the sender's clock; None if the packet does not have a time.
        seq: the sample's number; None if the packet does not have one.
    """

    trackers: QuaternionPoses
    time: float | None = None
    seq: int | None = None


def from_json(datagram: bytes) -> Packet:
    """Read the packet of a JSON datagram. Raises InputError for anything else."""
    try:
        fields = json.loads(datagram)
    except (ValueError, RecursionError):
        raise InputError("packet: must be JSON") from None
    if not isinstance(fields, dict):
        raise InputError("packet: must be a JSON object")
    return read_packet(fields)


def from_osc(datagram: bytes) -> Packet:
    """Read the packet of an OSC bundle. Raises InputError for anything else."""
    from pythonosc.osc_bundle import OscBundle
    from pythonosc.osc_message import OscMessage

    logging.disable(logging.WARNING)  # the library warns of each datagram that it can't read
    try:
        parts = [part for part in OscBundle(datagram) if isinstance(part, OscMessage)]
        arguments = {part.address.removeprefix(PREFIX): list(part.params) for part in parts}
    except Exception as error:  # the library raises many kinds over bytes that are not OSC
        raise InputError(f"packet: must be an OSC bundle ({error})") from None
    finally:
        logging.disable(logging.NOTSET)
    numbers = {key: arguments[key][0] for key in ("time", "seq") if arguments.get(key)}
    return read_packet(arguments | numbers)


def read_packet(fields: Mapping[str, Any]) -> Packet:
    """Return the packet with named values. Raises InputError if they are malformed.

    Whether times and rotations are valid is checked by the stream.
    """
    if not any(name in fields for name in TRACKERS):
        raise InputError(f"packet: must have {', '.join(TRACKERS)}")
    seq = fields.get("seq")
    if seq is not None and not isinstance(seq, int):
        raise InputError("seq: must be an integer")
    head, left, right = (_read_pose(name, fields.get(name)) for name in TRACKERS)
    return Packet((head, left, right), fields.get("time"), seq)


def _read_pose(name: str, values: Any) -> QuaternionPose:
    if values is None:
        return None
    try:
        pose = np.array(values, np.float64)
    except (TypeError, ValueError, OverflowError):
        pose = np.empty(0)
    if pose.shape != (POSE,):
        raise InputError(f"{name}: must be {POSE} numbers")
    return pose[:3], pose[3:]


class SourceSample(NamedTuple):
    """A sample from a source.

    Attributes:
        time: seconds of the trackers' clock.
        trackers: head, left and right.
        arrived: the time of arrival, seconds of `time.perf_counter`.
        dropped: how many samples were lost before this one.
    """

    time: float
    trackers: QuaternionPoses
    arrived: float
    dropped: int = 0


class TrackerSource(Protocol):
    """Gives tracker poses, one sample after the other.

    Attributes:
        name: the source's description.
        space: the frame of reference of its poses.
        worn: whether the poses come from a wearer's devices, so that the stream can be fitted.
    """

    name: str
    space: SpaceName
    worn: bool

    def read(self) -> SourceSample | None:
        """Return the next sample; None if none came within `WAIT` seconds.

        Raises InputError for a malformed sample.
        """

    def truth(self, time: float) -> np.ndarray | None:
        """Return the true joints (22, 3), metres, AMASS' world, at a time; None if they are unknown."""

    def close(self) -> None:
        """Release the source's resources."""


class TrackedClip:
    """A clip, from which tracker poses and true joints can be read at any time.

    Args:
        name: the clip's name.
        frames: [X | Theta] (N, 252) at 60 Hz, world (`memmlp.motion.body`).
    """

    def __init__(self, name: str, frames: np.ndarray):
        self.name = name
        frames = np.asarray(frames, np.float64)
        self.positions = frames[:, SPARSE_POSITION].reshape(-1, 3, 3)
        self.rotations = sixd_to_matrix(frames[:, SPARSE_ROTATION].reshape(-1, 6)).reshape(-1, 3, 3, 3)
        self.joints = frames[:, SPARSE_DIM : SPARSE_DIM + MOTION_DIM][:, POSITION].reshape(-1, N_JOINTS, 3)
        self.seconds = (len(frames) - 1) / FPS

    def trackers(self, time: float) -> QuaternionPoses:
        """Return position and quaternion (xyzw) of head, left and right wrist at a time, interpolated."""
        first, _ = self._place(time)
        a, b = (TrackerSample(i / FPS, self.positions[i], self.rotations[i]) for i in (first, first + 1))
        sample = interpolate(a, b, time)
        head, left, right = zip(sample.positions, matrix_to_quaternion(sample.rotations), strict=True)
        return head, left, right

    def truth(self, time: float) -> np.ndarray:
        """Return the joints (22, 3), metres, world, at a time, interpolated, or at the clip's nearest end."""
        first, weight = self._place(time)
        return self.joints[first] + weight * (self.joints[first + 1] - self.joints[first])

    def _place(self, time: float) -> tuple[int, float]:
        """Return the index of the frame before a time, and the fraction of the way to the next frame."""
        first = min(max(int(time * FPS), 0), len(self.joints) - 2)
        return first, min(max(time * FPS - first, 0.0), 1.0)


def npz_frames(path: Path, rest: np.ndarray) -> np.ndarray:
    """Return the frames (N, 252) of an AMASS npz, resampled to 60 Hz, on a network's body.

    Args:
        path: the file.
        rest: the body's joints in the rest pose (22, 3), metres, SMPL's body frame.

    Raises:
        InputError: for a clip of fewer than 3 frames at 60 Hz, or one that was imported onto another body.
    """
    import torch

    from memmlp.motion.body import check_imported_body
    from memmlp.motion.clip import resample
    from memmlp.motion.formats.npz import read_clip
    from memmlp.motion.geometry import motion_frames
    from memmlp.motion.plausibility import check_plausible

    recorded = read_clip(path, path.stem)
    check_imported_body([path], rest, "the network")
    if faults := check_plausible(path, recorded):
        notify(f"{path}: unusual, {faults}")
    clip, _ = resample(recorded)
    if len(clip) < 3:
        raise InputError(f"{path}: {len(clip)} frames at 60 Hz; must have 3 or more")
    tensors = (torch.tensor(part) for part in (clip.poses, clip.trans, rest))
    return motion_frames(*tensors).numpy()


class ClipSource:
    """Plays a clip as a headset would send it: at a fixed rate, in real time, in endless rounds.

    A sample that is due while the last one is still being processed is dropped, as with a device.

    Args:
        clip: the clip.
        hz: samples per second.
        clock: returns the time, seconds; the machine's by default.
        sleep: waits for a number of seconds; the machine's by default.
    """

    space: SpaceName = "amass"
    worn = False

    def __init__(
        self,
        clip: TrackedClip,
        hz: float,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ):
        self.clip, self.hz, self.name = clip, float(hz), f"{clip.name} at {hz:g} Hz"
        self.count = int(clip.seconds * hz + 1e-9) + 1  # samples of a round
        self.clock, self.sleep = clock, sleep
        self.next = 0
        self.start: float | None = None

    def read(self) -> SourceSample | None:
        """Wait for the sample that is due next, and return it."""
        now = self.clock()
        self.start = now if self.start is None else self.start
        due = int((now - self.start) * self.hz + 1e-6)
        dropped = max(due - self.next, 0)
        index = self.next + dropped
        self.sleep(max(self.start + index / self.hz - now, 0))
        self.next = index + 1
        turn, step = divmod(index, self.count)
        within = step / self.hz
        trackers = self.clip.trackers(within)
        return SourceSample(turn * self.round_seconds + within, trackers, time.perf_counter(), dropped)

    @property
    def round_seconds(self) -> float:
        """The seconds from the beginning of one round to the beginning of the next."""
        return (self.count - 1) / self.hz + PAUSE

    def truth(self, time: float) -> np.ndarray:
        """Return the true joints (22, 3), metres, AMASS' world."""
        half = PAUSE / 2  # so that a time that rounding puts before a round's beginning belongs to it
        return self.clip.truth((time + half) % self.round_seconds - half)

    def close(self) -> None:
        """Do nothing, since this source holds no resources."""


class PacketSource:
    """Takes packets that arrive at a UDP port, from this machine and from listed other machines.

    Args:
        name: the kind of packets, for messages.
        port: the port; 0 for any free one.
        parse: reads the packet of a datagram, or raises InputError.
        space: the frame of reference of the poses.
        senders: the other machines whose packets are accepted; without any, only this machine can reach the
            port.
        report: gets a line about each machine whose packets are rejected.

    Raises:
        InputError: if the port is in use.
    """

    worn = True

    def __init__(
        self,
        name: str,
        port: int,
        parse: Callable[[bytes], Packet],
        space: SpaceName,
        senders: Sequence[IPv4Network] = (),
        report: Callable[[str], None] = lambda line: None,
    ):
        self.parse, self.space, self.senders, self.report = parse, space, senders, report
        self.strangers: set[str] = set()
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.settimeout(WAIT)
        try:
            self.socket.bind((EVERYWHERE if senders else HOST, port))
        except OSError as error:
            self.socket.close()
            if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                raise
            raise InputError(f"port {port}: is in use or forbidden; use another one, 1024 to 65535") from None
        self.port = self.socket.getsockname()[1]
        self.name = f"{name} packets on port {self.port}"
        self.last: int | None = None

    def read(self) -> SourceSample | None:
        """Return the next packet's sample; None if no packet came in time, or if it is left out.

        A packet that others have overtaken is left out; it was counted as lost when they came. Raises
        InputError for a malformed packet.
        """
        try:
            datagram, (sender, _) = self.socket.recvfrom(LARGEST)
        except TimeoutError:
            return None
        arrived = time.perf_counter()
        address = ip_address(sender)
        if not address.is_loopback and not any(address in network for network in self.senders):
            if sender not in self.strangers and len(self.strangers) < REPORTED:
                self.strangers.add(sender)
                self.report(f"packets from {sender} are ignored; accept them with --sender {sender}")
            return None
        packet = self.parse(datagram)
        dropped = 0
        if self.last is not None and packet.seq is not None:
            if 0 < self.last - packet.seq <= OVERTAKEN:
                return None
            missing = packet.seq - self.last - 1
            dropped = missing if 0 < missing < RESTARTED else 0
        self.last = packet.seq
        now = time.monotonic() if packet.time is None else packet.time
        return SourceSample(now, packet.trackers, arrived, dropped)

    def truth(self, time: float) -> None:
        """Return None, since the truth is unknown."""

    def close(self) -> None:
        """Release the port."""
        self.socket.close()
