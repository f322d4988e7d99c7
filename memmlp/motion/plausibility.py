"""The faults of a clip: reasons why it cannot be a person's motion, and likely mistakes in other clips.

Files do not state their units. The limits leave room for human motion (jumping, lying, crawling, climbing,
dancing far from the origin, on a floor of any height): wrong units are off by factors of 39 to 1000, and a
wrong axis by 90 degrees.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.ndimage import median_filter
from scipy.spatial.transform import Rotation

from memmlp.common.errors import InputError
from memmlp.motion.body import HEAD, JOINTS, PARENTS, builtin_rest_joints
from memmlp.motion.clip import PIECE, Clip, is_known_rate, nearest_rate

ANKLES, KNEES, ELBOWS = (
    [JOINTS.index(f"{side}_{joint}") for side in ("left", "right")] for joint in ("ankle", "knee", "elbow")
)
LEGS = [JOINTS.index(f"{side}_{joint}") for side in ("left", "right") for joint in ("hip", "knee")]
MOST_TURN = 4 * math.pi  # rotation vectors need no more than pi; fits wind up to 2 pi and more
MOST_SPEED = 30.0  # m/s; the fastest runner reached 12.4
MOST_HEIGHT = 10.0  # metres of the pelvis over z = 0, beyond which feet must stand still at times
LOWEST = 0.3  # metres of the lowest joint over or below z = 0, beyond which sliding feet are a fault
RATES = (20.0, 500.0)  # Hz between which motion is recorded; others may be mistakes, as 12 for 120
STIFF = 0.01  # radians by which a joint that does not turn may turn in a clip
BACKWARDS = 0.3  # radians of knees and elbows that bend the wrong way; stretched ones came to 0.08
SAMPLES = 50  # frames that are tested for posture
JUMP = 8.0  # steps of the frames around it; recorded motion came to 5, a cut or a jump by 1 m begins at 13
AROUND, SLOWEST = 9, 0.3  # frames, and m/s that are added to their median step, as resting bodies tremble
FROZEN, TURNING = 0.5, 0.1  # seconds without any change of trans, in which a leg turns faster, rad/s


def check_plausible(path: Path, clip: Clip) -> str:
    """Return the faults of a clip that can be a person's motion (`find_faults`), in one line.

    Raises:
        InputError: for a clip that cannot; the message names the file.
    """
    reason = why_implausible(clip)
    if reason is not None:
        raise InputError(f"{path}: {reason}")
    return "; ".join(find_faults(clip))


def why_implausible(clip: Clip) -> str | None:
    """Return why a clip cannot be a person's motion in radians, metres and with Z up, or None."""
    share = (np.linalg.norm(clip.poses, axis=-1).max(1) > MOST_TURN).mean()
    if share > 0.5:
        return f"rotations beyond two turns in {share:.0%} of the frames, so poses is in degrees, not radians"
    speeds = np.linalg.norm(np.diff(clip.trans, axis=0), axis=-1) * clip.fps
    if len(speeds) and (speed := np.quantile(speeds, 0.75)) > MOST_SPEED:  # fewer frames may be glitches
        fast = f"the pelvis moves at {speed:.0f} m/s in a quarter of the frames"
        return f"{fast}, so trans is not in metres, or the frame rate is wrong"
    height = float(np.median(clip.trans[:, 2]))
    if abs(height) > MOST_HEIGHT and not _feet_hold(clip):
        where = f"the pelvis is at z = {height:.0f} m and no joint is at rest while it moves"
        return f"{where}, so trans is not in metres"
    return "the person stands along Y and never along Z, so Y is up, not Z" if _is_y_up(clip) else None


def find_faults(clip: Clip) -> Iterator[str]:
    """Yield likely mistakes in a clip that can be a person's motion, one sentence each."""
    joints = _pose_sample(clip, _spread(clip))
    if (joints[:, HEAD, 2] - joints[:, 0, 2] > 0.2).mean() < 0.02:
        yield "the head is never above the pelvis, so the person lies throughout, or Z is not up"
    low, high = RATES
    if not low <= clip.fps <= high:
        yield f"a frame rate of {clip.fps:g} Hz, which may be wrong; usual are {low:g} to {high:g} Hz"
    elif not is_known_rate(clip.fps):
        nearest = f"the nearest usual one is {nearest_rate(clip.fps):g} Hz"
        yield f"a frame rate of {clip.fps:.6g} Hz, which may be wrong; {nearest}"
    if len(clip) > 1 and np.ptp(clip.poses[:, 1:], axis=0).max() <= STIFF:
        yield "no joint but the root turns, so it is a pose for calibration, or its poses are lost"
    # On SMPL's body knees bend about +X, the left elbow about -Y, and the right one about +Y.
    poses = clip.poses[_spread(clip)]
    left, right = poses[:, ELBOWS, 1].T
    for name, bent in (("knees", poses[:, KNEES, 0]), ("elbows", (right - left) / 2)):
        if np.median(bent) < -BACKWARDS:
            yield f"the {name} bend backwards, so left and right are swapped, or an axis is mirrored"
    # A trans of other axes or units than the poses', or of zeros, lifts or sinks the body and does not fit
    # the steps. On a floor at another height than zero the feet stand still.
    lowest = float(np.quantile(joints[:, :, 2].min(1), 0.05))
    if abs(lowest) > LOWEST and not _feet_hold(clip):
        where = f"the lowest joint is at z = {lowest:.1f} m and none stands still while the pelvis moves"
        yield f"{where}, so trans may have other units or axes than metres with Z up, or lack the heights"
    yield from _find_jumps(clip)


def _find_jumps(clip: Clip) -> Iterator[str]:
    """Yield the largest jump from one frame to the next, and the longest time for which trans is frozen."""
    if len(clip) < AROUND:
        return
    pieces = [
        np.arange(start, min(start + PIECE, len(clip) - 1) + 1) for start in range(0, len(clip) - 1, PIECE)
    ]
    positions = (_pose_sample(clip, piece) for piece in pieces)
    steps = np.concatenate([np.linalg.norm(np.diff(at, axis=0), axis=-1).mean(1) for at in positions])
    ratio = steps / (median_filter(steps, AROUND, mode="nearest") + SLOWEST / clip.fps)
    if ratio.max() > JUMP:
        frame = int(ratio.argmax())
        far = f"the joints move by {steps[frame]:.2f} m on average from frame {frame} to the next"
        yield f"{far}, many times as far as before and after: a jump, or a cut"
    still = (np.diff(clip.trans, axis=0) == 0).all(-1)
    turns = np.abs(np.diff(clip.poses[:, LEGS], axis=0)).max((1, 2)) * clip.fps
    ends = np.flatnonzero(np.diff(np.concatenate([[False], still & (turns > TURNING), [False]]).astype(int)))
    longest = int(np.diff(ends)[::2].max(initial=0))
    if longest > FROZEN * clip.fps:
        yield f"trans does not change in {longest} successive frames while the legs turn, so it may be lost"


def _is_y_up(clip: Clip) -> bool:
    """Return whether a person stands along Y and never along Z, on a floor.

    People who lie throughout with the head towards +Y rarely have the feet at y = 0. They also do not rise
    by a metre while the feet stay in one plane.
    """
    joints = _pose_sample(clip, _spread(clip))

    def standing(axis: int) -> float:
        """Return the share of frames with the head well above the pelvis, and the pelvis above an ankle."""
        heights = joints[:, :, axis] - joints[:, :1, axis]
        return float(((heights[:, HEAD] > 0.4) & (heights[:, ANKLES].min(1) < -0.5)).mean())

    if standing(axis=2) > 0.02 or standing(axis=1) < 0.6:
        return False
    low, middle, high = np.quantile(joints[:, :, 1].min(1), [0.05, 0.5, 0.95])
    return not (abs(middle) > 0.2 and (high - low > 0.35 or np.ptp(joints[:, 0, 2]) < 1.0))


def _feet_hold(clip: Clip) -> bool:
    """Return whether, in half of the frames in which the pelvis moves, some joint moves at half its speed."""
    frames = _spread(clip, len(clip) - 1)
    moved = np.linalg.norm(_pose_sample(clip, frames + 1) - _pose_sample(clip, frames), axis=-1)
    moving = moved[:, 0] * clip.fps > 0.01
    return bool(moving.any() and np.median(moved[moving].min(1) / moved[moving, 0]) < 0.5)


def _spread(clip: Clip, last: int | None = None) -> np.ndarray:
    """Return indices of up to SAMPLES frames, spread over the clip."""
    last = len(clip) if last is None else last
    return np.arange(last)[:: max(1, -(-last // SAMPLES))]


def _pose_sample(clip: Clip, frames: np.ndarray) -> np.ndarray:
    """Return the joints' positions (n, 22, 3), metres, world, in some frames, on the built-in body."""
    rest, poses = builtin_rest_joints(), clip.poses[frames]
    local = Rotation.from_rotvec(poses.reshape(-1, 3)).as_matrix().reshape(*poses.shape, 3)
    rotations, positions = [local[:, 0]], [clip.trans[frames] + rest[0]]
    for joint, parent in enumerate(PARENTS[1:], start=1):
        positions.append(positions[parent] + rotations[parent] @ (rest[joint] - rest[parent]))
        rotations.append(rotations[parent] @ local[:, joint])
    return np.stack(positions, 1)
