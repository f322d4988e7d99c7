"""From samples of three trackers, each at its own time, to frames at the network's rate and their features.

The rules apply in this order:

- A **lost** hand is held at its last pose as seen from the head: it moves with the head and turns with its
  heading. A lost head stays where it was. Before its first sample a tracker is held at the T-pose of a person
  under the head (standing at the origin before the head's first). When a tracker returns, it is led to its
  true pose over `RECOVERY` seconds, because the network would take a jump for a fast movement.
- **Frames** lie on a grid of 1 / fps from the first sample on. A frame is made as soon as there is a sample
  at or after its time, by interpolation between the samples beside it (positions linearly, rotations by
  slerp). No sample of the future is waited for, and a pose is at most one frame older than the newest sample.
  A frame may also lie a little after its sample, by `EARLY` at most, since times are rounded; it is then
  extrapolated, but no further than `FURTHEST`. A slow tracker gives several frames at once, a fast one none
  at some samples, and the rate may change at any time.
- A sample that is not newer than the last one is **ignored**.
- After a **gap** (no sample for longer than `GAP` seconds, or a clock that was set back by more) everything
  begins anew.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from memmlp.live.rotations import BodyTree, slerp, turned_by
from memmlp.motion.body import (
    SPARSE_ANGULAR_VELOCITY,
    SPARSE_DIM,
    SPARSE_POSITION,
    SPARSE_ROTATION,
    SPARSE_VELOCITY,
)

GAP = 0.5  # seconds without a sample after which everything begins anew
RECOVERY = 0.2  # seconds over which a tracker that returns is led to its true pose
EARLY = 5e-4  # seconds that a frame may lie after its sample, since times are rounded to milliseconds
FURTHEST = 1.1  # of the way from one sample to the next; two that came together tell no speed
SAME = 1e-6  # seconds; a sample this near to a frame is taken as the frame

TRACKERS = ("head", "left", "right")
NOBODY = (False, False, False)
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


def between(a: TrackerSample, b: TrackerSample, time: float) -> TrackerSample:
    """Return the trackers at a time, interpolated between the samples before and after it.

    A time shortly after both samples is extrapolated, as it comes from rounded times, but no further than
    `FURTHEST`: two samples that arrived almost together do not tell a speed.
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
    turn = about_vertical(heading) @ UPRIGHT
    rest = body.rest[body.tracked]
    return TrackerSample(0.0, place + (rest - rest[0]) @ turn.T, np.tile(turn, (3, 1, 1)))


def about_vertical(angle: float) -> np.ndarray:
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
        body: the body whose T-pose stands for a tracker that was never seen.
        recovery: seconds over which a tracker that returns is led to its true pose; 0 for a jump.
    """

    def __init__(self, body: BodyTree, recovery: float = RECOVERY):
        self.body, self.recovery = body, recovery
        self.reset()

    def reset(self) -> None:
        """Forget everything, as if no tracker had been seen yet."""
        self.last: TrackerSample | None = None
        self.lost: Lost = NOBODY
        self.settled = -np.inf  # time from which all trackers that returned are at their true poses
        self.returned = np.full(3, -np.inf)  # time from which each tracker's difference shrinks
        self.shift, self.turn = np.zeros((3, 3)), np.tile(np.eye(3), (3, 1, 1))

    def __call__(self, sample: TrackerSample, lost: Lost) -> TrackerSample:
        """Return the sample with lost trackers filled in, and returning ones on the way to true poses."""
        last = self.last or self._first(sample, lost)
        returning = [was and not is_lost for was, is_lost in zip(self.lost, lost, strict=True)]
        self.last, self.lost = sample, lost
        if any(returning):
            self._return(returning, last, sample)
        if sample.time < self.settled:
            self.last = self._on_their_way(sample)
        if any(lost):
            self.last = held(self.last, lost, last)
        return self.last

    def _first(self, sample: TrackerSample, lost: Lost) -> TrackerSample:
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

    def _return(self, which: list[bool], last: TrackerSample, sample: TrackerSample) -> None:
        """Remember how far the returning trackers are from the poses at which they were held."""
        self.returned[which], self.settled = last.time, last.time + self.recovery
        self.shift[which] = (last.positions - sample.positions)[which]
        self.turn[which] = (last.rotations @ sample.rotations.swapaxes(1, 2))[which]

    def _on_their_way(self, sample: TrackerSample) -> TrackerSample:
        """Return the sample with the remaining share of these differences added."""
        left = np.clip(1 - (sample.time - self.returned) / self.recovery, 0, 1)
        positions = sample.positions + left[:, None] * self.shift
        return TrackerSample(sample.time, positions, turned_by(self.turn, left) @ sample.rotations)


def held(sample: TrackerSample, lost: Lost, last: TrackerSample) -> TrackerSample:
    """Return the sample with lost trackers at their last poses, as seen from the head."""
    positions, rotations = sample.positions.copy(), sample.rotations.copy()
    if lost[0]:
        positions[0], rotations[0] = last.positions[0], last.rotations[0]
    turn = about_vertical(heading_of(rotations[0]) - heading_of(last.rotations[0]))
    hands = [index for index in (1, 2) if lost[index]]
    positions[hands] = positions[0] + (last.positions[hands] - last.positions[0]) @ turn.T
    rotations[hands] = turn @ last.rotations[hands]
    return TrackerSample(sample.time, positions, rotations)


class Taken(NamedTuple):
    """The result of a sample: the frames that are due, and whether everything began anew with it."""

    frames: list[TrackerSample]
    restarted: bool


class Resampler:
    """Turns samples into frames at times 1 / fps apart, from the first sample on.

    Args:
        fps: frames per second.
        gap: seconds without a sample after which frames begin anew.
    """

    def __init__(self, fps: float, gap: float = GAP):
        self.fps, self.gap = fps, gap
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next sample counts as the first."""
        self.last: TrackerSample | None = None
        self.origin, self.count = 0.0, 0

    @property
    def next(self) -> float:
        """The time of the next frame, seconds."""
        return self.origin + self.count / self.fps

    def restarts(self, time: float) -> bool:
        """Return whether frames begin anew with a sample at the given time."""
        return self.last is None or abs(time - self.last.time) > self.gap

    def is_old(self, time: float) -> bool:
        """Return whether a sample at the given time is not newer than the last one."""
        return self.last is not None and -self.gap <= time - self.last.time <= 0

    def take(self, sample: TrackerSample) -> list[TrackerSample]:
        """Return the frames that are due with a sample, which must be newer than the last one."""
        if self.last is None:
            self.origin, self.last = sample.time, sample
        frames = []
        while (time := self.next) <= sample.time + EARLY:
            same = abs(time - sample.time) <= SAME
            frames.append(sample if same else between(self.last, sample, time))
            self.count += 1
        self.last = sample
        return frames


class TrackerFrames:
    """Turns samples of three trackers into frames at the network's rate, by the rules at this file's top.

    Args:
        body: the network's body.
        fps: the network's frames per second.
    """

    def __init__(self, body: BodyTree, fps: float):
        self.hold, self.grid = Hold(body), Resampler(fps)

    def reset(self) -> None:
        """Begin anew."""
        self.hold.reset()
        self.grid.reset()

    def take(self, time: float | None, positions: np.ndarray, rotations: np.ndarray, lost: Lost) -> Taken:
        """Return the frames that are due with a sample.

        Args:
            time: seconds; None for the time of the next frame, which is then exactly this sample.
            positions: (3, 3), metres, AMASS' world.
            rotations: (3, 3, 3), AMASS' world.
            lost: which trackers are lost.
        """
        if time is None:
            time = self.grid.next
        if self.grid.is_old(time):
            return Taken([], False)
        restarted = self.grid.restarts(time)
        if restarted:
            self.reset()
        sample = self.hold(TrackerSample(time, positions, rotations), lost)
        return Taken(self.grid.take(sample), restarted)


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
