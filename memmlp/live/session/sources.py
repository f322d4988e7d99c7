"""Sources of tracker poses: a clip that is played, or packets that arrive at this machine."""

from __future__ import annotations

import errno
import math
import socket
import time
from collections.abc import Callable, Sequence
from ipaddress import IPv4Network, ip_address
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from memmlp.common.errors import InputError
from memmlp.common.progress import notify
from memmlp.live.rotations import matrix_to_quaternion, quaternion_to_matrix, sixd_to_matrix
from memmlp.live.session.packets import Packet, Parse, QuaternionPoses
from memmlp.live.spaces import Space, SpaceName
from memmlp.live.tracker_resampling import TrackerSample, between
from memmlp.motion.body import (
    FPS,
    MOTION_DIM,
    N_JOINTS,
    POSITION,
    SPARSE_DIM,
    SPARSE_POSITION,
    SPARSE_ROTATION,
)

HOST = "127.0.0.1"
EVERYWHERE = "0.0.0.0"
TOLD = 3  # strangers that are told of
WAIT = 0.25  # seconds that `read` waits at most
PAUSE = 1.0  # seconds between two rounds of a clip, so long that the stream begins anew
LARGEST = 65_536  # the largest datagram, bytes
OVERTAKEN = 20  # packets that may overtake another; a number further back is a sender that began anew
FORGOTTEN = 10_000  # so many missing numbers are not lost packets but another sender


class SourceSample(NamedTuple):
    """A sample from a source.

    Attributes:
        time: seconds of the trackers' clock.
        trackers: head, left and right.
        dropped: how many samples were lost before this one.
        arrived: the time of arrival, seconds of `time.perf_counter`; None for the time at which it is
            returned.
    """

    time: float
    trackers: QuaternionPoses
    dropped: int = 0
    arrived: float | None = None


class TrackerSource(Protocol):
    """Gives tracker poses, one sample after the other.

    Attributes:
        name: the source in words.
        space: the frame of reference of its poses.
        malformed: how many packets could not be read.
        foreign: how many packets came from machines whose packets are not taken.
        worn: whether the poses come from a wearer's devices, so that the stream can be fitted.
    """

    name: str
    space: SpaceName
    malformed: int
    foreign: int
    worn: bool

    def read(self) -> SourceSample | None:
        """Return the next sample; None if none came within `WAIT` seconds."""

    def truth(self, time: float) -> np.ndarray | None:
        """Return the true joints (22, 3), metres, at a time; None if they are not known."""

    def close(self) -> None:
        """Release what the source holds."""


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
        sample = between(a, b, time)
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

    from memmlp.motion.clip import resample
    from memmlp.motion.formats.npz import read_clip
    from memmlp.motion.geometry import motion_frames
    from memmlp.motion.plausibility import check_plausible, unusual
    from memmlp.motion.preparing.imported_body import check_imported_body

    recorded = read_clip(path, path.stem)
    check_imported_body([path], rest, "the network")
    check_plausible(path, recorded)
    if reason := unusual(recorded):
        notify(f"{path}: unusual, {reason}")
    clip, _ = resample(recorded)
    if len(clip) < 3:
        raise InputError(f"{path}: {len(clip)} frames at 60 Hz; allowed are 3 or more")
    tensors = (torch.tensor(part) for part in (clip.poses, clip.trans, rest))
    return motion_frames(*tensors).numpy()


def in_space(trackers: QuaternionPoses, space: Space) -> QuaternionPoses:
    """Convert trackers, positions and quaternions (xyzw), from AMASS' world to a frame of reference."""
    positions, rotations = (np.stack(part) for part in zip(*filter(None, trackers), strict=True))
    matrices = space.rotations_out(quaternion_to_matrix(rotations))
    head, left, right = zip(space.positions_out(positions), matrix_to_quaternion(matrices), strict=True)
    return head, left, right


class ClipSource:
    """Plays a clip as a headset would send it: at a fixed rate, in real time, in repeated rounds.

    A sample that is due while the last one is still being processed is dropped, as with a device.

    Args:
        clip: the clip.
        hz: samples per second.
        rounds: how often the clip is played; endlessly by default.
        clock: returns the time, seconds; the machine's by default.
        sleep: waits for a number of seconds; the machine's by default.
    """

    space: SpaceName = "amass"
    malformed = foreign = 0
    worn = False

    def __init__(
        self,
        clip: TrackedClip,
        hz: float,
        rounds: float = math.inf,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ):
        self.clip, self.hz, self.name = clip, float(hz), f"{clip.name} at {hz:g} Hz"
        self.count = int(clip.seconds * hz + 1e-9) + 1  # samples of a round
        self.rounds, self.clock, self.sleep = rounds, clock, sleep
        self.next = 0
        self.began: float | None = None

    @property
    def over(self) -> bool:
        """Whether all rounds have been played."""
        return self.next >= self.rounds * self.count

    def read(self) -> SourceSample | None:
        """Wait for the sample that is due next, and return it."""
        now = self.clock()
        self.began = now if self.began is None else self.began
        due = int((now - self.began) * self.hz + 1e-6)
        last = self.rounds * self.count - 1  # who comes late to the end gets it, and no round that is none
        dropped = int(max(min(due, last) - self.next, 0))
        index = self.next + dropped
        self.sleep(max(self.began + index / self.hz - now, 0))
        self.next = index + 1
        turn, step = divmod(index, self.count)
        within = step / self.hz
        return SourceSample(turn * self.round_seconds + within, self.clip.trackers(within), dropped)

    @property
    def round_seconds(self) -> float:
        """The seconds from the beginning of one round to the beginning of the next."""
        return (self.count - 1) / self.hz + PAUSE

    def truth(self, time: float) -> np.ndarray:
        """Return the true joints (22, 3), metres, AMASS' world."""
        half = PAUSE / 2  # nearer to a round's beginning it belongs to it, even where floats put it before
        return self.clip.truth((time + half) % self.round_seconds - half)

    def close(self) -> None:
        """Do nothing, since this source holds no resources."""


class PacketSource:
    """Takes packets that arrive at a UDP port, from this machine and from listed other machines.

    Args:
        name: the kind of packets, in words.
        port: the port; 0 for any free one.
        parse: reads the packet of a datagram, or raises ValueError.
        space: the frame of reference of the poses.
        senders: the other machines whose packets are taken; without any, only this machine can reach the
            port.
        tell: gets a line about each machine whose packets are refused.

    Raises:
        InputError: if the port is taken.
    """

    worn = True

    def __init__(
        self,
        name: str,
        port: int,
        parse: Parse,
        space: SpaceName,
        senders: Sequence[IPv4Network] = (),
        tell: Callable[[str], None] = lambda line: None,
    ):
        self.parse, self.space, self.senders, self.tell = parse, space, senders, tell
        self.malformed = self.foreign = 0
        self.strangers: set[str] = set()
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.settimeout(WAIT)
        bind(self.socket, port, EVERYWHERE if senders else HOST)
        self.port = self.socket.getsockname()[1]
        self.name = f"{name} packets on port {self.port}"
        self.last: int | None = None

    def read(self) -> SourceSample | None:
        """Return the next packet's sample; None if no packet came in time, or if the packet is not taken.

        A packet that others have overtaken is not taken; it was counted as lost when they came.
        """
        try:
            datagram, (sender, _) = self.socket.recvfrom(LARGEST)
        except TimeoutError:
            return None
        arrived = time.perf_counter()
        if not self._known(sender):
            self._refuse(sender)
            return None
        try:
            packet = self.parse(datagram)
        except ValueError:
            self.malformed += 1
            return None
        if self._overtaken(packet):
            return None
        now = time.monotonic() if packet.time is None else packet.time
        return SourceSample(now, packet.trackers, self._dropped(packet), arrived)

    def _known(self, sender: str) -> bool:
        address = ip_address(sender)
        return address.is_loopback or any(address in network for network in self.senders)

    def _refuse(self, sender: str) -> None:
        self.foreign += 1
        if sender not in self.strangers and len(self.strangers) < TOLD:
            self.strangers.add(sender)
            self.tell(f"packets from {sender} are ignored; --sender {sender} takes them")

    def _overtaken(self, packet: Packet) -> bool:
        """Return whether a later packet came before, after which these poses would be taken for new ones."""
        if self.last is None or packet.seq is None:
            return False
        return 0 < self.last - packet.seq <= OVERTAKEN

    def _dropped(self, packet: Packet) -> int:
        """Return how many sample numbers are missing between the last packet and this one."""
        last, self.last = self.last, packet.seq
        if last is None or packet.seq is None:
            return 0
        missing = packet.seq - last - 1
        return missing if 0 < missing < FORGOTTEN else 0

    def truth(self, time: float) -> None:
        """Return None, since the truth is not known."""

    def close(self) -> None:
        """Release the port."""
        self.socket.close()


def bind(listener: socket.socket, port: int, host: str = HOST) -> None:
    """Bind a socket to a port, by default on this machine alone. Raises InputError if the port is taken."""
    try:
        listener.bind((host, port))
    except OSError as error:
        listener.close()
        if error.errno not in (errno.EADDRINUSE, errno.EACCES):
            raise
        raise InputError(
            f"port {port}: taken, or not allowed; allowed is another one, 1024 to 65535"
        ) from None


def send(source: ClipSource, port: int, pack: Callable[[Packet], bytes], space: Space) -> tuple[int, bool]:
    """Send a clip's samples in a frame of reference to a UDP port of this machine, for all rounds.

    Returns:
        The number of samples sent, and whether any was refused, since nothing listened at the port then.
        Not every system tells.
    """
    sent, refused = 0, False
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.connect((HOST, port))  # so that a refusal is told, with the next packet
        while not source.over and (sample := source.read()) is not None:
            trackers = in_space(sample.trackers, space)
            packet = pack(Packet(trackers, sample.time, source.next - 1))
            try:
                sender.send(packet)
            except ConnectionRefusedError:  # of the one before
                refused = True
                sender.send(packet)
            sent += 1
    return sent, refused
