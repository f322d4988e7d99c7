"""Outputs of a live body: bones for VMC programs, trackers for VRChat, and recorded files.

**VMC** (protocol.vmc.info/english) is an OSC protocol. VSeeFace, Warudo, EVMC4U and other programs receive
it. The root stays at the origin. The hips contain all movement, because some programs ignore root movement.

**VRChat** (docs.vrchat.com/docs/osc-trackers) receives up to eight trackers and the head over OSC. Rotations
are Euler angles in degrees, in the order Z, X, Y. VRChat assigns the trackers when the user calibrates in a
T-pose. Then it aligns the head tracker with the avatar's head.

**Recordings**: all files of a recorder contain the same frames. Formats with a skeleton (BVH, glTF) have the
user's height; an npz file contains the motion of the network's body. Missing frames between two poses are
interpolated. After a longer break, the network restarts. Breaks are skipped in the files, and reported.
"""

import errno
import socket
import warnings
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
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
from memmlp.motion.exporting import find_format, write_motion
from memmlp.motion.formats.gltf import UNITY_BONES

VMC_PORT, VRCHAT_PORT = 39539, 9000
SPACE = SPACES["unity"]
HALF = 14  # number of messages in the first datagram; both datagrams fit into an Ethernet packet
LOADED, CALIBRATED, NORMAL = 1, 3, 0
LONGEST = 1.0  # maximum number of seconds that a recording interpolates
FIXED_ROOT = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)  # position and quaternion
# For each tracker: the joint of its position, and the joint of its rotation. A knee tracker turns with the
# thigh, and an elbow tracker with the upper arm.
PLACES = (
    ("pelvis", "pelvis"), ("spine3", "spine3"), ("left_ankle", "left_ankle"), ("right_ankle", "right_ankle"),
    ("left_knee", "left_hip"), ("right_knee", "right_hip"),
    ("left_elbow", "left_shoulder"), ("right_elbow", "right_shoulder"), ("head", "head"),
)  # fmt: skip
AT, TURNS_WITH = ([JOINTS.index(pair[k]) for pair in PLACES] for k in (0, 1))
TRACKERS = (*map(str, range(1, len(PLACES))), "head")


class Output(Protocol):
    """A receiver of frames, described by `name`. It never waits: it processes a frame immediately, or drops
    it."""

    name: str

    def take(self, frame: BodyFrame) -> None:
        """Process a frame. Raises OSError on failure."""

    def close(self) -> None:
        """Finish pending work, such as writing files."""


class Outputs:
    """Several outputs. A failing output is reported once, and the next frame is tried again."""

    def __init__(self, outputs: Sequence[Output], report: Callable[[str], None]):
        self.outputs, self.report = outputs, report
        self.failed: set[str] = set()

    def take(self, frame: BodyFrame) -> None:
        for output in self.outputs:
            try:
                output.take(frame)
            except OSError as error:
                if output.name not in self.failed:
                    self.failed.add(output.name)
                    self.report(f"{output.name}: {error.strerror or error}; other outputs continue")

    def close(self) -> None:
        """Close all outputs, even if some of them fail."""
        with ExitStack() as stack:
            for output in reversed(self.outputs):  # the stack calls the last one first
                stack.callback(output.close)


def encode_osc(messages: Iterable[tuple[str, str, Iterable[Any]]]) -> bytes:
    """Return an OSC bundle. Each message has an address, OSC type letters and arguments."""
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
    """The UDP address of a program that receives datagrams and need not run. `key` is the command-line option
    with the address, for messages. Raises InputError for an unknown host name."""

    def __init__(self, host: str, port: int, key: str):
        try:
            found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
            family, _, _, _, address = min(found, key=lambda one: one[0] != socket.AF_INET)  # IPv4 first
        except (OSError, UnicodeError) as error:
            reason = getattr(error, "strerror", None) or error
            raise InputError(f"{key} {host}: {reason}; expected HOST or HOST:PORT") from None
        self.address: tuple[Any, ...] = address
        self.socket = socket.socket(family, socket.SOCK_DGRAM)
        self.socket.setblocking(False)

    def __str__(self) -> str:
        return f"{self.address[0]}:{self.address[1]}"

    def send(self, datagram: bytes) -> None:
        """Send a datagram, or drop it if the network is busy. Raises OSError if the address cannot be
        reached."""
        try:
            self.socket.sendto(datagram, self.address)
        except OSError as error:
            if error.errno not in (errno.EAGAIN, errno.ENOBUFS):
                raise


class VMC:
    """An output that sends bones to a VMC program."""

    def __init__(self, receiver: Receiver):
        self.name = f"VMC to {receiver}"
        self.receiver, self.close = receiver, receiver.socket.close
        self.start: float | None = None

    def take(self, frame: BodyFrame) -> None:
        self.start = frame.time if self.start is None else self.start
        values = np.empty((N_JOINTS, 7))  # position (metres) and quaternion of each bone, parent's frame
        values[:, :3] = (frame.rest - frame.rest[list(PARENTS)]) * SPACE.body
        values[ROOT, :3] = SPACE.convert_positions_from_amass(frame.positions[ROOT])
        values[:, 3:] = matrix_to_quaternion(SPACE.convert_pose_from_amass(frame.local))
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
    """An output that sends trackers to VRChat."""

    def __init__(self, receiver: Receiver):
        self.name = f"VRChat at {receiver}"
        self.receiver, self.close = receiver, receiver.socket.close

    def take(self, frame: BodyFrame) -> None:
        parts = [f"{name}/{part}" for name in TRACKERS for part in ("position", "rotation")]
        vectors = place_trackers(frame).reshape(-1, 3).tolist()
        pairs = zip(parts, vectors, strict=True)
        self.receiver.send(encode_osc((f"/tracking/trackers/{part}", "fff", v) for part, v in pairs))


def place_trackers(frame: BodyFrame) -> np.ndarray:
    """Return positions (metres) and Euler angles (degrees) of eight trackers and the head (9, 2, 3), in
    Unity's axes."""
    turned = np.array(frame.local, np.float64)
    for joint in range(1, N_JOINTS):
        turned[joint] = turned[PARENTS[joint]] @ turned[joint]
    angles = compute_euler_angles(SPACE.convert_rotations_from_amass(turned[TURNS_WITH]))
    return np.stack([SPACE.convert_positions_from_amass(frame.positions[AT]), angles], 1)


def compute_euler_angles(rotations: np.ndarray) -> np.ndarray:
    """Return Unity's Euler angles (n, 3) about X, Y and Z, degrees. Ry Rx Rz equals rotations (n, 3, 3)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # warns about gimbal lock, where one angle is arbitrary
        return Rotation.from_matrix(rotations).as_euler("YXZ", degrees=True)[:, [1, 0, 2]]


class Recorder:
    """An output that stores frames of the network's `fps` and body (rest joints (22, 3), metres, SMPL's body
    frame), and on close writes files of the user's motion in the formats of their suffixes. `report` gets a
    line about each file. Raises InputError for an unknown suffix, an existing file, or a folder that cannot
    be written."""

    def __init__(self, paths: Sequence[Path], rest: np.ndarray, fps: float, report: Callable[[str], None]):
        for path in paths:
            find_format(path, "--record")
            if path.exists():
                raise InputError(f"--record {path}: already exists; must be a new file")
            try:
                path.parent.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise InputError(f"--record {path}: cannot be written ({error.strerror})") from None
        if len({path.resolve() for path in paths}) < len(paths):
            raise InputError("--record: must not name the same file twice")
        self.name = "recording " + ", ".join(path.name for path in paths)
        self.paths, self.rest, self.fps, self.report = paths, rest, fps, report
        self.rows: list[np.ndarray] = []  # per frame: rotation vectors and root position (69,)
        self.filled, self.breaks, self.scale = 0, 0, 1.0
        self.last: tuple[float, np.ndarray, np.ndarray] | None = None

    def take(self, frame: BodyFrame) -> None:
        """Store a frame. Missing frames before it are interpolated."""
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
        """Write the files. Raises InputError if a file cannot be written; the other files are still
        written."""
        if not self.rows:
            self.report("recording: no frame was received, so no file is written")
            return
        rows = np.stack(self.rows)
        with ExitStack() as stack:
            for path in reversed(self.paths):
                stack.callback(self._write, path, rows)

    def _write(self, path: Path, rows: np.ndarray) -> None:
        """Write a file, and report its length, breaks and interpolated frames."""
        chosen = find_format(path)
        scale = self.scale if chosen.has_bones else 1.0
        rest = self.rest / scale
        poses = rows[:, :-3].reshape(-1, N_JOINTS, 3)
        clip = Clip(path.stem, poses, rows[:, -3:] / scale - rest[ROOT], self.fps)
        write_motion(path, clip, rest, chosen)
        parts = [f"{path}: {len(clip) / self.fps:.1f} s"]
        if self.breaks:
            parts.append(f"{self.breaks} break{'s' * (self.breaks > 1)} skipped")
        if self.filled:
            parts.append(f"{self.filled} of {len(rows)} frames interpolated")
        self.report(", ".join(parts))
