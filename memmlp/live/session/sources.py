"""Sources of tracker poses: a recorded clip, or packets from the network.

One datagram is one sample, as JSON or as an OSC bundle (docs/guides/live.md). A pose is seven numbers, `x y z
qx qy qz qw`: metres and a unit quaternion. A tracker is lost if it is null or missing, or by the rules of
`memmlp.live.tracker_input.find_lost`. In OSC, a message without numbers is null. A packet without a time gets
its arrival time. `seq` is the number of the sample. It serves to count missing packets, and to drop packets
that arrive out of order.
"""

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
from memmlp.live.tracker_input import find_lost
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
POSE = 7  # number of values in a pose
REPORTED = 3  # maximum number of rejected machines to report
WAIT = 0.25  # maximum wait of `read`, seconds
PAUSE = 1.0  # seconds between two repetitions of a clip; long enough to restart the stream
LARGEST = 65_536  # maximum number of bytes of a datagram
OVERTAKEN = 20  # largest backward step of `seq` for a late packet; larger steps mean a restarted sender
RESTARTED = 10_000  # a forward step of this size means another sender instead of lost packets

QuaternionPose = tuple[np.ndarray, np.ndarray] | None
"""A tracker's position (3,), metres, and quaternion xyzw (4,); None for a lost tracker."""
QuaternionPoses = tuple[QuaternionPose, QuaternionPose, QuaternionPose]
"""The poses of head, left and right wrist."""


class Packet(NamedTuple):
    """One sample of head, left and right; `time` is seconds of the sender's clock; `seq` is the sample's
    number; both may be None."""

    trackers: QuaternionPoses
    time: float | None = None
    seq: int | None = None


def parse_json_packet(datagram: bytes) -> Packet:
    """Parse a JSON datagram. Raises InputError if it is malformed."""
    try:
        fields = json.loads(datagram)
    except (ValueError, RecursionError):
        raise InputError("packet: must be JSON") from None
    if not isinstance(fields, dict):
        raise InputError("packet: must be a JSON object")
    return read_packet(fields)


def parse_osc_packet(datagram: bytes) -> Packet:
    """Parse an OSC bundle. Raises InputError if it is malformed."""
    from pythonosc.osc_bundle import OscBundle
    from pythonosc.osc_message import OscMessage

    logging.disable(logging.WARNING)  # the library warns about each unreadable datagram
    try:
        parts = [part for part in OscBundle(datagram) if isinstance(part, OscMessage)]
        values = {part.address.removeprefix(PREFIX): list(part.params) for part in parts}
    except Exception as error:  # the library raises many kinds of errors
        raise InputError(f"packet: must be an OSC bundle ({error})") from None
    finally:
        logging.disable(logging.NOTSET)
    arguments = {key: None if all(one is None for one in many) else many for key, many in values.items()}
    numbers = {key: many[0] for key in ("time", "seq") if (many := arguments.get(key))}
    return read_packet(arguments | numbers)


def read_packet(fields: Mapping[str, Any]) -> Packet:
    """Make a packet from its fields. Raises InputError if a field is malformed. The stream checks later
    whether times and rotations are valid."""
    if not any(name in fields for name in TRACKERS):
        raise InputError(f"packet: must have at least one of {', '.join(TRACKERS)}")
    seq = fields.get("seq")
    if seq is not None and not isinstance(seq, int):
        raise InputError("seq: must be an integer")
    head, left, right = (_read_pose(name, fields.get(name)) for name in TRACKERS)
    return Packet((head, left, right), fields.get("time"), seq)


def _read_pose(name: str, values: Any) -> QuaternionPose:
    if not values:  # null, false or empty: lost
        return None
    try:
        pose = np.array(values, np.float64)
    except (TypeError, ValueError, OverflowError):
        pose = np.empty(0)
    if pose.shape != (POSE,):
        raise InputError(f"{name}: must be {POSE} numbers")
    return pose[:3], pose[3:]


class SourceSample(NamedTuple):
    """A sample of head, left and right: seconds of the trackers' clock, arrival time (seconds of
    `time.perf_counter`), and the number of lost samples before this one."""

    time: float
    trackers: QuaternionPoses
    arrived: float
    dropped: int = 0


class TrackerSource(Protocol):
    """A source of tracker samples in a frame of reference; `name` describes it. If `has_wearer`, a user wears
    the trackers, and the stream can be adjusted to the user."""

    name: str
    space: SpaceName
    has_wearer: bool

    def read(self) -> SourceSample | None:
        """Return the next sample; None if no sample arrives within `WAIT` seconds. Raises InputError for a
        malformed sample."""

    def get_true_joints(self, time: float) -> np.ndarray | None:
        """Return the true joints (22, 3), metres, AMASS' world, at a time; None if unknown."""

    def close(self) -> None:
        """Release all resources."""


class TrackedClip:
    """A clip with interpolated tracker poses and true joints, from frames [X | Theta] (N, 252) at 60 Hz,
    world."""

    def __init__(self, name: str, frames: np.ndarray):
        self.name = name
        frames = np.array(frames, np.float64)  # a copy, because poses of lost trackers become NaN
        self.positions = frames[:, SPARSE_POSITION].reshape(-1, 3, 3)
        with np.errstate(invalid="ignore"):  # rotations of zeros become NaN
            self.rotations = sixd_to_matrix(frames[:, SPARSE_ROTATION].reshape(-1, 6)).reshape(-1, 3, 3, 3)
        poses = np.concatenate([self.positions, self.rotations.reshape(-1, 3, 9)], 2)
        lost = find_lost(poses.reshape(-1, 12)).reshape(-1, 3)
        self.positions[lost] = self.rotations[lost] = np.nan  # so that no pose is interpolated
        self.joints = frames[:, SPARSE_DIM : SPARSE_DIM + MOTION_DIM][:, POSITION].reshape(-1, N_JOINTS, 3)
        self.seconds = (len(frames) - 1) / FPS

    def interpolate_trackers(self, time: float) -> QuaternionPoses:
        """Return positions and quaternions (xyzw) of head, left and right wrist at a time."""
        first, _ = self._locate(time)
        a, b = (TrackerSample(i / FPS, self.positions[i], self.rotations[i]) for i in (first, first + 1))
        sample = interpolate(a, b, time)
        head, left, right = zip(sample.positions, matrix_to_quaternion(sample.rotations), strict=True)
        return head, left, right

    def interpolate_joints(self, time: float) -> np.ndarray:
        """Return the true joints (22, 3), metres, world, at a time, clamped to the clip's length."""
        first, weight = self._locate(time)
        return self.joints[first] + weight * (self.joints[first + 1] - self.joints[first])

    def _locate(self, time: float) -> tuple[int, float]:
        """Return the index of the frame before a time, and the interpolation weight of the next frame."""
        first = min(max(int(time * FPS), 0), len(self.joints) - 2)
        return first, min(max(time * FPS - first, 0.0), 1.0)


def read_npz_frames(path: Path, rest: np.ndarray) -> np.ndarray:
    """Read an AMASS npz, and return its frames (N, 252) at 60 Hz on a body with rest joints (22, 3), metres,
    SMPL's body frame. Raises InputError if the clip has fewer than 3 frames at 60 Hz, or was imported onto
    another body."""
    import torch

    from memmlp.motion.body import check_imported_body
    from memmlp.motion.clip import resample
    from memmlp.motion.formats.npz import read_clip
    from memmlp.motion.geometry import compute_motion_frames
    from memmlp.motion.plausibility import check_plausible

    recorded = read_clip(path, path.stem)
    check_imported_body([path], rest, "the network")
    if faults := check_plausible(path, recorded):
        notify(f"{path}: is unusual ({faults})")
    clip, _ = resample(recorded)
    if len(clip) < 3:
        raise InputError(f"{path}: has {len(clip)} frames at 60 Hz; must have 3 or more")
    tensors = (torch.tensor(part) for part in (clip.poses, clip.trans, rest))
    return compute_motion_frames(*tensors).numpy()


class ClipSource:
    """Plays a clip in real time at a fixed rate, like a headset, and repeats it endlessly. A sample is
    dropped if the processing of the previous sample takes too long."""

    space: SpaceName = "amass"
    has_wearer = False

    def __init__(
        self,
        clip: TrackedClip,
        hz: float,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ):
        self.clip, self.hz, self.name = clip, float(hz), f"{clip.name} at {hz:g} Hz"
        self.count = int(clip.seconds * hz + 1e-9) + 1  # number of samples in a repetition
        self.clock, self.sleep = clock, sleep
        self.next = 0
        self.start: float | None = None

    def read(self) -> SourceSample | None:
        now = self.clock()
        self.start = now if self.start is None else self.start
        due = int((now - self.start) * self.hz + 1e-6)
        dropped = max(due - self.next, 0)
        index = self.next + dropped
        self.sleep(max(self.start + index / self.hz - now, 0))
        self.next = index + 1
        turn, step = divmod(index, self.count)
        within = step / self.hz
        trackers = self.clip.interpolate_trackers(within)
        return SourceSample(turn * self.round_seconds + within, trackers, time.perf_counter(), dropped)

    @property
    def round_seconds(self) -> float:
        """The seconds from the start of one repetition to the start of the next repetition."""
        return (self.count - 1) / self.hz + PAUSE

    def get_true_joints(self, time: float) -> np.ndarray:
        half = PAUSE / 2  # a time that is rounded to before the start of a repetition still belongs to it
        return self.clip.interpolate_joints((time + half) % self.round_seconds - half)

    def close(self) -> None:
        pass


class PacketSource:
    """Receives packets at a UDP port (0 for any free one), from this machine and from the machines in
    `senders`; without these, only this machine can reach the port. `name` is the kind of packets. `parse`
    parses a datagram, or raises InputError. `report` gets a line about each machine with rejected packets.
    Raises InputError if the port is in use."""

    has_wearer = True

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
            raise InputError(f"port {port}: is in use or forbidden; use another, 1024 to 65535") from None
        self.port = self.socket.getsockname()[1]
        self.name = f"{name} packets on port {self.port}"
        self.last: int | None = None

    def read(self) -> SourceSample | None:
        """Return the sample of the next packet; None if no packet arrives in time, or if it is late and
        dropped; it was already counted as lost. Raises InputError for a malformed packet."""
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

    def get_true_joints(self, time: float) -> None:
        return None

    def close(self) -> None:
        self.socket.close()
