"""Checks of a stream's samples: malformed trackers are rejected, and odd units or clocks give a warning."""

from __future__ import annotations

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

FARTHEST = 1e6  # metres; a tracker farther from the origin is taken as lost
LATEST = 1e10  # seconds; at much later times floats can't tell frames of 1/60 s apart
UNIT = 1e-2  # how far a quaternion's norm may be from 1
NEUTRAL = np.concatenate([np.zeros(3), np.eye(3).reshape(9)])

JUMPS, STILL = 5, 30  # samples in a row
COARSE = 1e-3  # seconds between neighbouring times
REACH = 5.0  # metres from head to hand; a hand in front of the face is as far in centimetres
HIGHEST = 3.0  # metres of a head above the floor

TrackerPose = tuple[ArrayLike, ArrayLike] | None


class SampleWarning(UserWarning):
    """A stream's samples can hardly be what it expects: metres, seconds, quaternions xyzw."""


def read_trackers(trackers: Sequence[TrackerPose]) -> tuple[np.ndarray, np.ndarray, Lost]:
    """Return positions (3, 3), rotations (3, 3, 3) and which trackers are lost, from a user's trackers.

    A lost tracker has the identity in place of its pose. Raises InputError if a tracker is malformed.
    """
    poses, quaternions = np.full((3, 12), np.nan), {}
    for index, (name, tracker) in enumerate(zip(TRACKERS, trackers, strict=True)):
        if tracker is None:
            continue
        try:
            position, rotation = (np.asarray(part, np.float64) for part in tracker)
        except (TypeError, ValueError) as error:
            raise InputError(f"{name}: expected (position, rotation), arrays of numbers, or None") from error
        if position.shape != (3,):
            raise InputError(f"{name}: a position of shape {position.shape}; expected (3,), metres")
        if rotation.shape not in ((4,), (3, 3)):
            raise InputError(f"{name}: a rotation of shape {rotation.shape}; expected (4,) xyzw or (3, 3)")
        poses[index, :3] = position
        if rotation.shape == (4,):
            quaternions[index] = rotation
        else:
            poses[index, 3:] = rotation.reshape(9)
    if quaternions:
        poses[list(quaternions), 3:] = _to_matrices(quaternions).reshape(-1, 9)
    lost = tuple((~(np.abs(poses) <= FARTHEST).all(1)).tolist())
    if any(lost):
        poses[list(lost)] = NEUTRAL
    positions, rotations = poses[:, :3], poses[:, 3:].reshape(3, 3, 3)
    check_rotations(list(TRACKERS), rotations)
    return positions, rotations, lost


def _to_matrices(quaternions: dict[int, np.ndarray]) -> np.ndarray:
    """Convert trackers' quaternions (4,), xyzw, to matrices (n, 3, 3).

    Zeros, which runtimes give for a lost tracker, become NaN. Raises InputError for another norm than 1.
    """
    array = np.array(list(quaternions.values()))
    norms = np.sqrt(np.einsum("ni,ni->n", array, array))
    for index, norm in zip(quaternions, norms.tolist(), strict=True):
        if abs(norm - 1) > UNIT and norm != 0 and math.isfinite(norm):
            raise InputError(f"{TRACKERS[index]}: a quaternion of norm {norm:.3g}; its norm must be 1 (xyzw)")
    norms[norms == 0] = np.nan
    return quaternion_to_matrix(array / norms[:, None])


def check_time(time: float | None) -> None:
    """Raise InputError for anything but a time in seconds or None."""
    if time is None:
        return
    if not isinstance(time, (int, float, np.integer, np.floating)) or not abs(time) <= LATEST:
        raise InputError(
            f"time={time}: must be a number of seconds, at most {LATEST:g}, or None for one frame"
        )


ODD = {
    "jump": (
        JUMPS,
        f"are over {GAP:g} s apart by their times, and the network restarts with each; is `time` in seconds?",
    ),
    "still": (STILL, "are no later than the ones before them, and make no frame; does `time` stand still?"),
    "coarse": (
        STILL,
        "have times of single precision, which is milliseconds so late, so that velocities are wrong; send "
        "`time` in double precision (OSC's d), or count from the start",
    ),
    "far": (JUMPS, f"have a hand over {REACH:g} m from the head; are positions in metres?"),
    "high": (
        STILL,
        f"have the head over {HIGHEST:g} m above the floor; are positions in metres, and is `floor` right?",
    ),
}
"""Kinds of odd samples: the number of odd samples in a row that triggers the warning, and its line."""


def warn_caller(line: str) -> None:
    """Warn the caller of this package."""
    frame, level = sys._getframe(), 1
    while frame.f_back and str(frame.f_globals.get("__name__")).startswith("memmlp.live."):
        frame, level = frame.f_back, level + 1
    warnings.warn(line, SampleWarning, stacklevel=level)


class OddSamples:
    """Detects odd samples of a stream, and warns once of each kind.

    Times in milliseconds jump at every sample, and each jump restarts the network. While a clock stands
    still, no frame is made. One in single precision, such as OSC's `f`, is coarse after some hours, and the
    velocities of the trackers are wrong then. Positions in other units than metres are far apart, and high.

    Args:
        report: gets a line at the first detection of each kind; by default it becomes a `SampleWarning`.
    """

    def __init__(self, report: Callable[[str], None] = warn_caller):
        self.report, self.reported = report, set[str]()
        self.last: float | None = None
        self.row = dict.fromkeys(ODD, 0)

    @property
    def jumping(self) -> bool:
        """Whether the times of so many successive samples jumped that no pause explains it."""
        return self.row["jump"] >= JUMPS

    def take(self, time: float | None, positions: np.ndarray, lost: Lost) -> None:
        """Take a sample.

        Args:
            time: seconds; None for a sample without a time.
            positions: of head, left and right (3, 3), metres of the network's body, above its floor, AMASS'
                axes.
            lost: which of them are lost.
        """
        odd_kinds: dict[str, bool] = {}
        if not lost[0]:
            head, *hands = positions.tolist()
            near = (
                gone or math.dist(head, hand) <= REACH for hand, gone in zip(hands, lost[1:], strict=True)
            )
            odd_kinds |= {"far": not all(near), "high": head[2] > HIGHEST}
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
                self.report(f"{least} samples in a row {line}")
