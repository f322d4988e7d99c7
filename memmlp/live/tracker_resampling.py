"""From samples of three trackers, each at its own time, to frames at the network's rate and their features.

The rules apply in this order:

- A **lost** hand is held at its last pose as seen from the head: it moves with the head and turns with its
  heading. A lost head stays where it was. Before its first sample a tracker is held at the T-pose of a person
  under the head (standing at the origin before the head's first). When a tracker returns, it is led to its
  true pose over `RECOVERY` seconds, because the network would take a jump for a fast movement.
- **Frames** lie on a grid of 1 / fps from the first sample on. A frame is made as soon as there is a sample
  at or after its time, by interpolation between the samples beside it (positions linearly, rotations by
  slerp). There is no look-ahead, and a pose is at most one frame older than the newest sample. A frame may
  also lie up to `EARLY` after its sample, since times are rounded; it is then extrapolated, but no further
  than `FURTHEST`. A slow tracker gives several frames at once, a fast one gives none at some samples, and
  the rate may change at any time.
- A sample that is not newer than the last one is **ignored**.
- After a **gap** (no sample for longer than `GAP` seconds, or a clock that was set back by more) everything
  restarts.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from memmlp.live.rotations import BodyTree, rotate_by_share, slerp
from memmlp.motion.body import (
    SPARSE_ANGULAR_VELOCITY,
    SPARSE_DIM,
    SPARSE_POSITION,
    SPARSE_ROTATION,
    SPARSE_VELOCITY,
)

GAP = 0.5  # seconds without a sample after which everything restarts
RECOVERY = 0.2  # seconds over which a tracker that returns is led to its true pose
EARLY = 5e-4  # seconds that a frame may lie after its sample, since times are rounded to milliseconds
FURTHEST = 1.1  # of the way between two samples; two that arrive together do not show a speed
SAME = 1e-6  # seconds; a sample this near to a frame is taken as the frame

TRACKERS = ("head", "left", "right")
NONE_LOST = (False, False, False)
UPRIGHT = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # SMPL's body frame (Y up) to AMASS' (Z up)

Lost = tuple[bool, ...]  # whether head, left and right wrist are lost


class TrackerSample(NamedTuple):
    """Poses of head, left and right wrist at a time, in AMASS' world.

    Attributes:
        time: seconds.
        positions: (3, 3), metres.
        rotations: (3, 3, 3).
    """

    time: float
    positions: np.ndarray
    rotations: np.ndarray


def interpolate(a: TrackerSample, b: TrackerSample, time: float) -> TrackerSample:
    """Return the trackers at a time, interpolated between the samples before and after it.

    A time shortly after both samples is extrapolated, but no further than `FURTHEST`.
    """
    weight = min((time - a.time) / (b.time - a.time), FURTHEST)
    positions = a.positions + weight * (b.positions - a.positions)
    return TrackerSample(time, positions, slerp(a.rotations, b.rotations, weight))


def t_pose(body: BodyTree, place: np.ndarray, heading: float) -> TrackerSample:
    """Return head and wrists of a person in T-pose whose head is at `place` (3,), metres, AMASS' world.

    Args:
        body: the person's rest pose.
        place: the head's position.
        heading: radians to the left of looking along -Y, where the person's left is +X.
    """
    turn = rotation_about_vertical(heading) @ UPRIGHT
    rest = body.rest[body.tracked]
    return TrackerSample(0.0, place + (rest - rest[0]) @ turn.T, np.tile(turn, (3, 1, 1)))


def rotation_about_vertical(angle: float) -> np.ndarray:
    """Return the rotation (3, 3) about AMASS' Z axis by an angle, radians."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def heading_of(rotation: np.ndarray) -> float:
    """Return the heading (radians, as in `t_pose`) of a joint's global rotation (3, 3).

    It is the rotation's twist about the vertical, so that looking up or down does not matter.
    """
    upright = rotation @ UPRIGHT.T
    return float(np.arctan2(upright[1, 0] - upright[0, 1], upright[0, 0] + upright[1, 1]))


class Hold:
    """Holds lost trackers at their last poses, and leads them smoothly to their true poses on their return.

    Args:
        body: the body whose T-pose stands for a tracker before its first sample.
        recovery: seconds over which a tracker that returns is led to its true pose; 0 for a jump.
    """

    def __init__(self, body: BodyTree, recovery: float = RECOVERY):
        self.body, self.recovery = body, recovery
        self.reset()

    def reset(self) -> None:
        """Forget all samples."""
        self.last: TrackerSample | None = None
        self.lost: Lost = NONE_LOST
        self.settled = -np.inf  # time from which all trackers that returned are at their true poses
        self.returned = np.full(3, -np.inf)  # time from which each tracker's difference shrinks
        self.shift, self.turn = np.zeros((3, 3)), np.tile(np.eye(3), (3, 1, 1))

    def fill(self, sample: TrackerSample, lost: Lost) -> TrackerSample:
        """Return the sample with lost trackers filled in, and returning ones on the way to true poses."""
        last = self.last or self._stand_in(sample, lost)
        returning = [was and not is_lost for was, is_lost in zip(self.lost, lost, strict=True)]
        self.lost = lost
        if any(returning):
            self.returned[returning], self.settled = last.time, last.time + self.recovery
            self.shift[returning] = (last.positions - sample.positions)[returning]
            self.turn[returning] = (last.rotations @ sample.rotations.swapaxes(1, 2))[returning]
        if sample.time < self.settled:
            share = np.clip(1 - (sample.time - self.returned) / self.recovery, 0, 1)
            positions = sample.positions + share[:, None] * self.shift
            rotations = rotate_by_share(self.turn, share) @ sample.rotations
            sample = TrackerSample(sample.time, positions, rotations)
        self.last = hold_lost(sample, lost, last) if any(lost) else sample
        return self.last

    def _stand_in(self, sample: TrackerSample, lost: Lost) -> TrackerSample:
        """Return a stand-in for the sample before the first: the first itself, if no tracker is lost.

        Otherwise it is the T-pose under the head; without a head, the T-pose of a person standing at the
        origin.
        """
        if not any(lost):
            return sample
        if lost[0]:
            height = self.body.rest[self.body.tracked[0], 1] - self.body.rest[:, 1].min()
            return t_pose(self.body, np.array([0.0, 0.0, height]), 0.0)
        return t_pose(self.body, sample.positions[0], heading_of(sample.rotations[0]))


def hold_lost(sample: TrackerSample, lost: Lost, last: TrackerSample) -> TrackerSample:
    """Return the sample with lost trackers at their last poses, as seen from the head."""
    positions, rotations = sample.positions.copy(), sample.rotations.copy()
    if lost[0]:
        positions[0], rotations[0] = last.positions[0], last.rotations[0]
    turn = rotation_about_vertical(heading_of(rotations[0]) - heading_of(last.rotations[0]))
    hands = [index for index in (1, 2) if lost[index]]
    positions[hands] = positions[0] + (last.positions[hands] - last.positions[0]) @ turn.T
    rotations[hands] = turn @ last.rotations[hands]
    return TrackerSample(sample.time, positions, rotations)


class TrackerFrames:
    """Turns samples of three trackers into frames at the network's rate, by the rules at this file's top.

    Args:
        body: the network's body.
        fps: the network's frames per second.
    """

    def __init__(self, body: BodyTree, fps: float):
        self.hold, self.fps = Hold(body), fps
        self.reset()

    def reset(self) -> None:
        """Restart: the next sample counts as the first."""
        self.hold.reset()
        self.last: TrackerSample | None = None
        self.origin, self.count = 0.0, 0

    @property
    def next(self) -> float:
        """The time of the next frame, seconds."""
        return self.origin + self.count / self.fps

    def take(
        self, time: float | None, positions: np.ndarray, rotations: np.ndarray, lost: Lost
    ) -> tuple[list[TrackerSample], bool]:
        """Return the frames that are due with a sample, and whether everything restarts with it.

        Args:
            time: seconds; None for the time of the next frame, which is then exactly this sample.
            positions: (3, 3), metres, AMASS' world.
            rotations: (3, 3, 3), AMASS' world.
            lost: which trackers are lost.
        """
        if time is None:
            time = self.next
        if self.last is not None and -GAP <= time - self.last.time <= 0:
            return [], False
        restarts = self.last is None or abs(time - self.last.time) > GAP
        if restarts:
            self.reset()
            self.origin = time
        sample = self.hold.fill(TrackerSample(time, positions, rotations), lost)
        last, frames = self.last or sample, []
        while (due := self.next) <= time + EARLY:
            frames.append(sample if abs(due - time) <= SAME else interpolate(last, sample, due))
            self.count += 1
        self.last = sample
        return frames, restarts


class Features:
    """Computes the network's 54 inputs frame by frame, as `memmlp.motion.geometry.sparse_features` does."""

    def __init__(self) -> None:
        self.last: TrackerSample | None = None

    def reset(self) -> None:
        """Forget the last frame: the next frame has zero velocities."""
        self.last = None

    def write(self, frame: TrackerSample, sparse: np.ndarray) -> None:
        """Write the inputs of a frame into sparse (54,)."""
        last = self.last or frame
        positions, rotations = frame.positions, frame.rotations
        turned = last.rotations.swapaxes(1, 2) @ rotations
        sparse[SPARSE_ROTATION] = rotations.swapaxes(1, 2)[:, :2].reshape(-1)
        sparse[SPARSE_ANGULAR_VELOCITY] = turned.swapaxes(1, 2)[:, :2].reshape(-1)
        sparse[SPARSE_POSITION] = positions.reshape(-1)
        sparse[SPARSE_VELOCITY] = (positions - last.positions).reshape(-1)
        self.last = frame


assert SPARSE_VELOCITY.stop == SPARSE_DIM
