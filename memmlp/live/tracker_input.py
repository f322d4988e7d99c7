"""Checks of a stream's samples: malformed trackers are rejected, and implausible values cause a warning."""

import math
import sys
import warnings
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from memmlp.common.errors import InputError
from memmlp.live.rotations import quaternion_to_matrix
from memmlp.live.tracker_resampling import GAP, TRACKERS, Lost
from memmlp.live.wearer import check_rotations

FARTHEST = 1e6  # metres; a tracker farther from the origin counts as lost
FROZEN = GAP  # seconds; a tracker that repeats its pose for longer, while another moves, counts as lost
LATEST = 1e10  # seconds; floats of much later times cannot resolve frames of 1/60 s
UNIT = 1e-2  # how far a quaternion's norm may be from 1
NEUTRAL = np.concatenate([np.zeros(3), np.eye(3).reshape(9)])

JUMPS, STILL = 5, 30  # number of consecutive samples
COARSE = 1e-3  # seconds; times with a coarser resolution are odd
REACH = 5.0  # metres from head to hand; positions in centimetres are farther apart
HIGHEST = 3.0  # metres; maximum height of the head above the floor

TrackerPose = tuple[ArrayLike, ArrayLike] | None


class SampleWarning(UserWarning):
    """A warning about samples that are probably not in metres, seconds or quaternions xyzw."""


def find_lost(poses: np.ndarray, still: np.ndarray | float = 0.0) -> np.ndarray:
    """Return which trackers (n,) are lost, given poses (n, 12), position and matrix, with NaN without a pose,
    and for how many seconds (n,) each has repeated its pose while another moved. Programs report a lost
    tracker without a pose, as NaN, far away, at the exact origin, without a rotation, or with its last pose
    repeated. `isLost` in the web page's stream.js follows the same rules."""
    has_pose = (np.abs(poses) <= FARTHEST).all(1) & poses[:, :3].any(1) & poses[:, 3:].any(1)
    return ~has_pose | (np.asarray(still) > FROZEN)


class TrackerReader:
    """Reads the samples of three trackers; `fps` applies to samples without a time. `still` is how long, in
    seconds, each has repeated its pose while another tracker moved."""

    def __init__(self, fps: float):
        self.period = 1 / fps
        self.still, self.last, self.time = np.zeros(3), np.full((3, 12), np.nan), -math.inf

    def take(
        self, trackers: Sequence[TrackerPose], time: float | None
    ) -> tuple[np.ndarray, np.ndarray, Lost]:
        """Read a sample at a time (seconds, or None for the next frame); see `read`."""
        poses, norms = _read_poses(trackers)
        elapsed = self.period if time is None else time - self.time
        moved = (poses != self.last).any(1) & ~find_lost(poses)
        self.still = np.where(moved, 0, self.still + moved.any() * (elapsed if 0 < elapsed <= GAP else 0))
        self.last[moved] = poses[moved]
        self.time = self.time + self.period if time is None else time
        return self._check(poses, norms)

    def read(self, trackers: Sequence[TrackerPose]) -> tuple[np.ndarray, np.ndarray, Lost]:
        """Convert trackers to positions (3, 3), rotations (3, 3, 3) and lost flags, without counting them. A
        lost tracker gets the identity as its pose. Raises InputError if a tracker is malformed."""
        return self._check(*_read_poses(trackers))

    def _check(self, poses: np.ndarray, norms: np.ndarray) -> tuple[np.ndarray, np.ndarray, Lost]:
        lost = find_lost(poses, self.still)
        for name, norm in zip(TRACKERS, norms.tolist(), strict=True):
            if abs(norm - 1) > UNIT and UNIT <= norm < math.inf:
                raise InputError(f"{name}: quaternion has norm {norm:.3g}; must be 1 (xyzw)")
        poses[lost] = NEUTRAL
        positions, rotations = poses[:, :3], poses[:, 3:].reshape(3, 3, 3)
        check_rotations(list(TRACKERS), rotations)
        return positions, rotations, tuple(lost.tolist())


def _read_poses(trackers: Sequence[TrackerPose]) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and matrices (3, 12), and the norms of quaternions (3,), 1 for matrices. A lost
    tracker may have NaN, also as its norm. Raises InputError for another shape."""
    poses, quaternions = np.full((3, 12), np.nan), {}
    for index, (name, tracker) in enumerate(zip(TRACKERS, trackers, strict=True)):
        try:
            if tracker is None or any(part is None for part in tracker):
                continue
            position, rotation = (np.asarray(part, np.float64) for part in tracker)
        except (TypeError, ValueError) as error:
            raise InputError(f"{name}: expected (position, rotation) as arrays, or None") from error
        if position.shape != (3,):
            raise InputError(f"{name}: position has shape {position.shape}; must be (3,), metres")
        if rotation.shape not in ((4,), (3, 3)):
            raise InputError(f"{name}: rotation has shape {rotation.shape}; must be (4,) xyzw or (3, 3)")
        poses[index, :3] = position
        if rotation.shape == (4,):
            quaternions[index] = rotation
        else:
            poses[index, 3:] = rotation.reshape(9)
    norms = np.ones(3)
    if quaternions:
        array, indices = np.array(list(quaternions.values())), list(quaternions)
        norms[indices] = found = np.sqrt(np.einsum("ni,ni->n", array, array))
        found = np.where((found >= UNIT) & np.isfinite(found), found, np.nan)  # zeros are not a rotation
        poses[indices, 3:] = quaternion_to_matrix(array / found[:, None]).reshape(-1, 9)
    return poses, norms


def check_time(time: float | None) -> None:
    """Raise InputError unless `time` is a time in seconds or None."""
    is_number = isinstance(time, (int, float, np.integer, np.floating))
    if time is not None and not (is_number and abs(time) <= LATEST):
        raise InputError(f"time={time}: must be seconds, at most {LATEST:g}, or None")


ODD = {
    "jump": (
        JUMPS,  # times in milliseconds jump at every sample
        f"have times over {GAP:g} s apart, and each restarts the network; check that `time` is in seconds",
    ),
    "still": (
        STILL,
        "have times that do not increase, and give no frames; check that `time` does not stand still",
    ),
    "coarse": (
        STILL,  # single precision, such as OSC's `f`, is coarse after some hours
        "have times in single precision, which are too coarse for velocities; send `time` in double "
        "precision (OSC's d), or count from the start",
    ),
    "far": (JUMPS, f"have a hand over {REACH:g} m from the head; check that positions are in metres"),
    "high": (
        STILL,
        f"have the head over {HIGHEST:g} m above the floor; check `floor`, and that positions are in metres",
    ),
}
"""Kinds of odd samples: the number of consecutive samples that triggers each warning, and its text."""


def warn_caller(line: str) -> None:
    """Issue a SampleWarning that shows the first line of code outside of memmlp.live."""
    frame, level = sys._getframe(), 1
    while frame.f_back and str(frame.f_globals.get("__name__")).startswith("memmlp.live."):
        frame, level = frame.f_back, level + 1
    warnings.warn(line, SampleWarning, stacklevel=level)


class OddSamples:
    """Detects odd samples of a stream. At the first detection of each kind (`ODD`), `report` gets a line; by
    default, it issues a `SampleWarning`."""

    def __init__(self, report: Callable[[str], None] = warn_caller):
        self.report, self.reported = report, set[str]()
        self.last: float | None = None
        self.row = dict.fromkeys(ODD, 0)

    @property
    def jumping(self) -> bool:
        """Whether the times of at least five consecutive samples jumped, which a pause cannot explain."""
        return self.row["jump"] >= JUMPS

    def take(self, time: float | None, positions: np.ndarray, lost: Lost) -> None:
        """Check a sample: its time in seconds or None, positions (3, 3) of head, left and right, scaled to
        the network's body and floor (metres, AMASS' axes), and lost flags."""
        odd_kinds: dict[str, bool] = {}
        if not lost[0]:
            head, *hands = positions.tolist()
            seen = (hand for hand, gone in zip(hands, lost[1:], strict=True) if not gone)
            is_far = any(not math.dist(head, hand) <= REACH for hand in seen)
            odd_kinds |= {"far": is_far, "high": head[2] > HIGHEST}
        if time is not None:
            later = math.inf if self.last is None else time - self.last
            self.last, single = time, np.float32(time)
            odd_kinds |= {
                "jump": GAP < abs(later) < math.inf,
                "still": -GAP <= later <= 0,
                "coarse": float(single) == time and float(np.spacing(single)) > COARSE,
            }
        for kind, odd in odd_kinds.items():
            self.row[kind] = self.row[kind] + 1 if odd else 0
            least, line = ODD[kind]
            if self.row[kind] == least and kind not in self.reported:
                self.reported.add(kind)
                self.report(f"{least} consecutive samples {line}")
