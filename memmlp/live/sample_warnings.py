"""Samples that a stream takes although they are hardly metres, or seconds of a clock; it says so."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from memmlp.live.tracker_resampling import GAP, Lost

JUMPS, STILL = 5, 30  # samples in a row
COARSE = 1e-3  # seconds between neighbouring times
REACH = 5.0  # metres from head to hand, which nobody has; a hand before the face is as far in centimetres
HIGHEST = 3.0  # metres of a head above the floor


class SampleWarning(UserWarning):
    """A stream's samples can hardly be what it takes: metres, seconds, quaternions xyzw."""


class Odd(NamedTuple):
    """A kind of odd samples: how many in a row show it, and what is said then."""

    row: int
    words: str


ODD = {
    "jump": Odd(
        JUMPS,
        f"are over {GAP:g} s apart by their times, and the network begins anew with each; "
        "is `time` in seconds?",
    ),
    "still": Odd(
        STILL, "are no later than the ones before them, and no frame is made; does `time` stand still?"
    ),
    "coarse": Odd(
        STILL,
        "have times of single precision, which is milliseconds so late; velocities are wrong with them: send "
        "`time` in double precision (OSC's d), or count from the start",
    ),
    "far": Odd(JUMPS, f"have a hand over {REACH:g} m from the head; are positions in metres?"),
    "high": Odd(
        STILL,
        f"have the head over {HIGHEST:g} m above the floor; are positions in metres, and is `floor` right?",
    ),
}


def warn(line: str) -> None:
    """Warn whoever called the stream's method."""
    warnings.warn(line, SampleWarning, stacklevel=4)


class OddSamples:
    """Detects odd samples of a stream, and says so once of each kind.

    Times in milliseconds jump at every sample, and each jump restarts the network. While a clock stands
    still, no frame is made. One in single precision, such as OSC's `f`, is coarse after some hours, and the
    velocities of the trackers are wrong then. Positions in other units than metres are far apart, and high.

    Args:
        tell: gets a line at the first detection of each kind; by default it becomes a `SampleWarning`.
    """

    def __init__(self, tell: Callable[[str], None] = warn):
        self.tell, self.told = tell, set[str]()
        self.last: float | None = None
        self.row = dict.fromkeys(ODD, 0)

    @property
    def jumping(self) -> bool:
        """Whether the times of so many successive samples jumped that no pause explains it."""
        return self.row["jump"] >= ODD["jump"].row

    def take(self, time: float | None, positions: np.ndarray, lost: Lost) -> None:
        """Take a sample.

        Args:
            time: seconds; None for a sample without a time.
            positions: of head, left and right (3, 3), metres of the network's body, above its floor, AMASS'
                axes.
            lost: which of them are lost.
        """
        found = _odd_places(positions, lost)
        if time is not None:
            found |= self._odd_times(time)
        for kind, odd in found.items():
            self.row[kind] = self.row[kind] + 1 if odd else 0
            if self.row[kind] == ODD[kind].row and kind not in self.told:
                self.told.add(kind)
                self.tell(f"{ODD[kind].row} samples in a row {ODD[kind].words}")

    def take_calibration(self, words: str) -> None:
        """Tell what is odd about a calibration, each time."""
        self.tell(f"calibrate: {words}")

    def _odd_times(self, time: float) -> dict[str, bool]:
        """Return what is odd about a sample's time, seconds."""
        later = math.inf if self.last is None else time - self.last
        self.last = time
        single = np.float32(time)
        return {
            "jump": GAP < abs(later) < math.inf,
            "still": -GAP <= later <= 0,
            "coarse": float(single) == time and float(np.spacing(single)) > COARSE,
        }


def _odd_places(positions: np.ndarray, lost: Lost) -> dict[str, bool]:
    """Return what is odd about where the trackers are that are not lost; nothing without a head."""
    if lost[0]:
        return {}
    head, *hands = positions.tolist()
    far = any(math.dist(head, hand) > REACH for hand, gone in zip(hands, lost[1:], strict=True) if not gone)
    return {"far": far, "high": head[2] > HIGHEST}
