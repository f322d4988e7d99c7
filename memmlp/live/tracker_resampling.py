"""Resampling of three trackers to frames at the network's rate, and the features of these frames.

The rules apply in this order:

- **Lost trackers** are held. A lost hand keeps its last pose relative to the head: it moves with the head and
  turns with the head's heading. A lost head keeps its last pose. A tracker without a sample gets its pose
  from a T-pose under the head, or at the origin without a sample of the head. When a tracker returns, it
  moves to its true pose over `RECOVERY` seconds. A jump would look like a fast movement to the network.
- **Frames** have a constant distance of 1 / fps, starting at the first sample. A frame is computed when a
  sample at or after its time arrives. It is interpolated between the neighbouring samples (positions
  linearly, rotations by slerp). There is no look-ahead, and a pose is at most one frame older than the newest
  sample. Because times are rounded, a frame may also be up to `EARLY` seconds after its sample. Then it is
  extrapolated up to `FURTHEST`. A sample can give no frame or several frames; the rate may change.
- **Old samples**, not newer than the previous sample, are ignored.
- **Gaps** restart everything. A gap is more than `GAP` seconds without a sample, or a clock that jumps back
  by more than `GAP` seconds.
"""

from typing import NamedTuple

import numpy as np

from memmlp.live.rotations import BodyTree, rotate_by_fraction, slerp
from memmlp.motion.body import (
    SPARSE_ANGULAR_VELOCITY,
    SPARSE_POSITION,
    SPARSE_ROTATION,
    SPARSE_VELOCITY,
)

GAP = 0.5  # seconds without a sample after which everything restarts
RECOVERY = 0.2  # seconds until a returning tracker is at its true pose
EARLY = 5e-4  # maximum seconds of a frame after its sample, because times are rounded to milliseconds
FURTHEST = 1.1  # maximum interpolation weight; samples with almost equal times do not show a speed
SAME = 1e-6  # seconds; a sample this close to a frame is used as the frame

TRACKERS = ("head", "left", "right")
NONE_LOST = (False, False, False)
UPRIGHT = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # SMPL's body frame (Y up) to AMASS' (Z up)

Lost = tuple[bool, ...]  # whether head, left and right wrist are lost


class TrackerSample(NamedTuple):
    """Poses of head, left and right wrist at one time (seconds), in AMASS' world: positions (3, 3), metres,
    and rotations (3, 3, 3)."""

    time: float
    positions: np.ndarray
    rotations: np.ndarray


def interpolate(a: TrackerSample, b: TrackerSample, time: float) -> TrackerSample:
    """Interpolate between two samples. A time shortly after both samples is extrapolated, up to
    `FURTHEST`."""
    weight = min((time - a.time) / (b.time - a.time), FURTHEST)
    positions = a.positions + weight * (b.positions - a.positions)
    return TrackerSample(time, positions, slerp(a.rotations, b.rotations, weight))


def make_t_pose(body: BodyTree, place: np.ndarray, heading: float) -> TrackerSample:
    """Return head and wrists of a person in a T-pose, with the head at `place` (3,), metres, AMASS' world. At
    `heading` 0, the person looks along -Y and the left side is +X; it counts in radians to the left."""
    turn = make_vertical_rotation(heading) @ UPRIGHT
    rest = body.rest[body.tracked]
    return TrackerSample(0.0, place + (rest - rest[0]) @ turn.T, np.tile(turn, (3, 1, 1)))


def make_vertical_rotation(angle: float) -> np.ndarray:
    """Return the rotation (3, 3) about AMASS' Z axis by an angle, radians."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def compute_heading(rotation: np.ndarray) -> float:
    """Return the heading (radians, as in `make_t_pose`) of a joint's global rotation (3, 3): its twist about
    the vertical, so looking up or down does not change it."""
    upright = rotation @ UPRIGHT.T
    return float(np.arctan2(upright[1, 0] - upright[0, 1], upright[0, 0] + upright[1, 1]))


class LostTrackerFiller:
    """Holds lost trackers at their last poses, and moves returning trackers to their true poses. A T-pose of
    the network's body gives the poses of trackers before their first samples."""

    def __init__(self, body: BodyTree):
        self.body = body
        self.last: TrackerSample | None = None
        self.lost: Lost = NONE_LOST
        self.settled = -np.inf  # time when all returning trackers are at their true poses
        self.returned = np.full(3, -np.inf)  # time when each tracker started to return
        self.shift, self.turn = np.zeros((3, 3)), np.tile(np.eye(3), (3, 1, 1))

    def fill(self, sample: TrackerSample, lost: Lost) -> TrackerSample:
        """Fill in the lost trackers of a sample, and smooth the poses of returning trackers."""
        last = self.last or self._make_stand_in(sample, lost)
        returning = [was and not is_lost for was, is_lost in zip(self.lost, lost, strict=True)]
        self.lost = lost
        if any(returning):
            self.returned[returning], self.settled = last.time, last.time + RECOVERY
            self.shift[returning] = (last.positions - sample.positions)[returning]
            self.turn[returning] = (last.rotations @ sample.rotations.swapaxes(1, 2))[returning]
        if sample.time < self.settled:
            share = np.clip(1 - (sample.time - self.returned) / RECOVERY, 0, 1)
            positions = sample.positions + share[:, None] * self.shift
            rotations = rotate_by_fraction(self.turn, share) @ sample.rotations
            sample = TrackerSample(sample.time, positions, rotations)
        self.last = hold_lost_trackers(sample, lost, last) if any(lost) else sample
        return self.last

    def _make_stand_in(self, sample: TrackerSample, lost: Lost) -> TrackerSample:
        """Return a previous sample for the first sample: the first sample itself if no tracker is lost,
        otherwise a T-pose under the head, or at the origin if the head is lost."""
        if not any(lost):
            return sample
        if lost[0]:
            height = self.body.rest[self.body.tracked[0], 1] - self.body.rest[:, 1].min()
            return make_t_pose(self.body, np.array([0.0, 0.0, height]), 0.0)
        return make_t_pose(self.body, sample.positions[0], compute_heading(sample.rotations[0]))


def hold_lost_trackers(sample: TrackerSample, lost: Lost, last: TrackerSample) -> TrackerSample:
    """Return the sample with lost trackers at their last poses relative to the head."""
    positions, rotations = sample.positions.copy(), sample.rotations.copy()
    if lost[0]:
        positions[0], rotations[0] = last.positions[0], last.rotations[0]
    turn = make_vertical_rotation(compute_heading(rotations[0]) - compute_heading(last.rotations[0]))
    hands = [index for index in (1, 2) if lost[index]]
    positions[hands] = positions[0] + (last.positions[hands] - last.positions[0]) @ turn.T
    rotations[hands] = turn @ last.rotations[hands]
    return TrackerSample(sample.time, positions, rotations)


class TrackerFrames:
    """Converts samples of three trackers to frames at the network's rate; see the module docstring."""

    def __init__(self, body: BodyTree, fps: float):
        self.body, self.fps = body, fps
        self.reset()

    def reset(self) -> None:
        """Restart. The next sample counts as the first sample."""
        self.hold = LostTrackerFiller(self.body)
        self.last: TrackerSample | None = None
        self.origin, self.count = 0.0, 0

    @property
    def next_time(self) -> float:
        return self.origin + self.count / self.fps

    def take(
        self, time: float | None, positions: np.ndarray, rotations: np.ndarray, lost: Lost
    ) -> tuple[list[TrackerSample], bool]:
        """Return the frames that a sample completes, and whether everything restarts with this sample. Its
        time is in seconds, None for that of the next frame; positions (3, 3), metres, and rotations (3, 3, 3)
        are in AMASS' world."""
        if time is None:
            time = self.next_time
        if self.last is not None and -GAP <= time - self.last.time <= 0:
            return [], False
        restarts = self.last is None or abs(time - self.last.time) > GAP
        if restarts:
            self.reset()
            self.origin = time
        sample = self.hold.fill(TrackerSample(time, positions, rotations), lost)
        last, frames = self.last or sample, []
        while (due := self.next_time) <= time + EARLY:
            frames.append(sample if abs(due - time) <= SAME else interpolate(last, sample, due))
            self.count += 1
        self.last = sample
        return frames, restarts


class FeatureWriter:
    """Computes the 54 network inputs frame by frame, like `motion.geometry.compute_sparse_features`."""

    last: TrackerSample | None = None

    def write(self, frame: TrackerSample, sparse: np.ndarray) -> None:
        """Write the inputs of a frame into sparse (54,). The first frame has zero velocities."""
        last = self.last or frame
        positions, rotations = frame.positions, frame.rotations
        turned = last.rotations.swapaxes(1, 2) @ rotations
        sparse[SPARSE_ROTATION] = rotations.swapaxes(1, 2)[:, :2].reshape(-1)
        sparse[SPARSE_ANGULAR_VELOCITY] = turned.swapaxes(1, 2)[:, :2].reshape(-1)
        sparse[SPARSE_POSITION] = positions.reshape(-1)
        sparse[SPARSE_VELOCITY] = (positions - last.positions).reshape(-1)
        self.last = frame
