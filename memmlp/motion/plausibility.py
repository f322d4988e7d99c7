"""Checks whether a clip can be human motion, and finds likely mistakes in its data.

Files do not state their units. Wrong units change sizes by factors of 39 to 1000, and a wrong axis changes
directions by 90 degrees. So the limits can be wide: they accept jumping, lying, crawling, climbing, and
dancing far from the origin, on a floor at any height."""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.ndimage import median_filter
from scipy.spatial.transform import Rotation

from memmlp.common.errors import InputError
from memmlp.motion.body import FPS, HEAD, JOINTS, PARENTS, make_builtin_rest_joints
from memmlp.motion.clip import PIECE, Clip, find_nearest_rate, is_known_rate

ANKLES, KNEES, ELBOWS, HIPS, TOES = (
    [JOINTS.index(f"{side}_{joint}") for side in ("left", "right")]
    for joint in ("ankle", "knee", "elbow", "hip", "foot")
)
SPINE = JOINTS.index("spine1")
LEGS = [JOINTS.index(f"{side}_{joint}") for side in ("left", "right") for joint in ("hip", "knee")]
MOST_TURN = 4 * math.pi  # pi would suffice for rotation vectors; fitted ones reach 2 pi and more
MOST_SPEED = 30.0  # m/s; the fastest runner reached 12.4
MOST_HEIGHT = 10.0  # metres from the pelvis to z = 0; farther away, feet must stand still at times
LOWEST = 0.3  # metres from the lowest joint to z = 0; farther away, sliding feet are a fault
RATES = (20.0, 500.0)  # Hz: range of usual rates; others may be mistakes, such as 12 instead of 120
STIFF = 0.01  # radians: maximum range of a joint that counts as not turning
BACKWARDS = 0.3  # radians: a larger bend in the wrong direction is a fault; stretched limbs reach 0.08
BACKWARD_FEET = 0.5  # cosine of feet and pelvis; recorded motion reaches -0.2
SAMPLES = 50  # maximum number of frames for posture checks
JUMP = 8.0  # ratio to surrounding steps; recorded motion reaches 5, cuts or jumps by 1 m exceed 13
AROUND, SLOWEST = 9, 0.3  # window, frames; m/s added to the median step, because resting bodies tremble
FROZEN = 0.5  # seconds with constant trans or poses
TURNING, MOVING = 0.1, 0.1  # rad/s of a leg, and m/s of trans, that move meanwhile


def check_plausible(path: Path, clip: Clip) -> str:
    """Return a clip's likely mistakes (`find_faults`) as one line. Raises InputError, with the file, if the
    clip cannot be human motion."""
    reason = explain_implausibility(clip)
    if reason is not None:
        raise InputError(f"{path}: {reason}")
    return "; ".join(find_faults(clip))


def explain_implausibility(clip: Clip) -> str | None:
    """Explain why a clip cannot be human motion in radians and metres with Z up; None if it can be."""
    share = (np.linalg.norm(clip.poses, axis=-1).max(1) > MOST_TURN).mean()
    if share > 0.5:
        return f"rotations exceed two turns in {share:.0%} of the frames, so poses is in degrees, not radians"
    speeds = np.linalg.norm(np.diff(clip.trans, axis=0), axis=-1) * clip.fps
    if len(speeds) and (speed := np.quantile(speeds, 0.75)) > MOST_SPEED:  # a few frames may be glitches
        fast = f"the pelvis moves at {speed:.0f} m/s in a quarter of the frames"
        return f"{fast}, so trans is not in metres, or the frame rate is wrong"
    height = float(np.median(clip.trans[:, 2]))
    if abs(height) > MOST_HEIGHT and not _has_resting_joint(clip):
        where = f"the pelvis is at z = {height:.0f} m, and no joint is at rest while the pelvis moves"
        return f"{where}, so trans is not in metres"
    return "the person stands along Y and never along Z, so Y is up, not Z" if _is_y_up(clip) else None


def find_faults(clip: Clip) -> Iterator[str]:
    """Yield the likely mistakes in a plausible clip, one sentence each."""
    joints = _compute_positions(clip, _spread_frames(len(clip)))
    if (joints[:, HEAD, 2] - joints[:, 0, 2] > 0.2).mean() < 0.02:
        yield "the head is never above the pelvis, so the person lies throughout, or Z is not up"
    low, high = RATES
    if not low <= clip.fps <= high:
        yield f"the frame rate {clip.fps:g} Hz may be wrong; usual rates are {low:g} to {high:g} Hz"
    elif not is_known_rate(clip.fps):
        nearest = f"the nearest usual rate is {find_nearest_rate(clip.fps):g} Hz"
        yield f"the frame rate {clip.fps:.6g} Hz may be wrong; {nearest}"
    if len(clip) > 1 and np.ptp(clip.poses[:, 1:], axis=0).max() <= STIFF:
        yield "only the root turns, so this is a calibration pose, or the poses are lost"
    # On SMPL's body knees bend about +X, the left elbow about -Y, and the right one about +Y.
    poses = clip.poses[_spread_frames(len(clip))]
    left, right = poses[:, ELBOWS, 1].T
    for name, bent in (("knees", poses[:, KNEES, 0]), ("elbows", (right - left) / 2)):
        if np.median(bent) < -BACKWARDS:
            yield f"the {name} bend backwards, so left and right are swapped, or an axis is mirrored"
    # If trans has wrong axes or units, or is zero, the height is wrong and the feet slide.
    # On a floor that is not at z = 0, the feet stand still at times.
    lowest = float(np.quantile(joints[:, :, 2].min(1), 0.05))
    if abs(lowest) > LOWEST and not _has_resting_joint(clip):
        where = f"the lowest joint is at z = {lowest:.1f} m, and no joint stands still while the pelvis moves"
        yield f"{where}, so trans may not be in metres with Z up, or may lack the heights"
    forward = np.cross(joints[:, HIPS[0]] - joints[:, HIPS[1]], joints[:, SPINE] - joints[:, 0])
    feet = joints[:, TOES].mean(1) - joints[:, ANKLES].mean(1)
    lengths = np.linalg.norm(feet, axis=-1) * np.linalg.norm(forward, axis=-1)
    if np.median((feet * forward).sum(-1) / lengths) < -BACKWARD_FEET:
        yield "the feet point backward relative to the pelvis, so left and right legs may be swapped"
    yield from _find_jumps(clip)
    checked = np.arange(len(clip))[:: max(1, round(clip.fps / FPS))][:MOST_FRAMES]
    if len(checked) >= AROUND:
        rate = clip.fps / checked[1]
        yield from find_dynamic_faults(_compute_positions(clip, checked), rate, clip.fps)


def _find_jumps(clip: Clip) -> Iterator[str]:
    """Yield descriptions of the largest jump between two frames and of the longest constant trans or pose."""
    if len(clip) < AROUND:
        return
    last, starts = len(clip) - 1, range(0, len(clip) - 1, PIECE)
    pieces = (np.arange(start, min(start + PIECE, last) + 1) for start in starts)
    positions = (_compute_positions(clip, piece) for piece in pieces)
    steps = np.concatenate([np.linalg.norm(np.diff(at, axis=0), axis=-1).mean(1) for at in positions])
    ratio = steps / (median_filter(steps, AROUND, mode="nearest") + SLOWEST / clip.fps)
    if ratio.max() > JUMP:
        frame = int(ratio.argmax())
        far = f"the joints move by {steps[frame]:.2f} m on average after frame {frame}"
        yield f"{far}, much farther than in the frames around it: a jump or a cut"
    moves = np.diff(clip.trans, axis=0)
    speeds = np.linalg.norm(moves, axis=-1) * clip.fps
    turns = np.abs(np.diff(clip.poses, axis=0)) * clip.fps
    for what, moving, is_lost in (
        ("trans", "the legs turn", (moves == 0).all(-1) & (turns[:, LEGS].max((1, 2)) > TURNING)),
        ("the pose", "trans moves", (turns == 0).all((1, 2)) & (speeds > MOVING)),
    ):
        longest = int(np.diff(_find_runs(is_lost)).max(initial=0))
        if longest > FROZEN * clip.fps:
            yield f"{what} is constant for {longest} successive frames while {moving}, so it may be lost"


def _is_y_up(clip: Clip) -> bool:
    """Return whether the person stands along Y, and never along Z. A person who lies with the head towards +Y
    looks similar, but rarely has the feet at y = 0, and does not rise by a metre while the feet stay in one
    plane."""
    joints = _compute_positions(clip, _spread_frames(len(clip)))

    def measure_standing(axis: int) -> float:
        """Return the fraction of frames in which the person stands upright along an axis."""
        heights = joints[:, :, axis] - joints[:, :1, axis]
        return float(((heights[:, HEAD] > 0.4) & (heights[:, ANKLES].min(1) < -0.5)).mean())

    if measure_standing(axis=2) > 0.02 or measure_standing(axis=1) < 0.6:
        return False
    low, middle, high = np.quantile(joints[:, :, 1].min(1), [0.05, 0.5, 0.95])
    return not (abs(middle) > 0.2 and (high - low > 0.35 or np.ptp(joints[:, 0, 2]) < 1.0))


def _has_resting_joint(clip: Clip) -> bool:
    """Return whether some joint is slower than half the pelvis' speed in half of the frames with motion."""
    frames = _spread_frames(len(clip) - 1)
    moved = np.linalg.norm(_compute_positions(clip, frames + 1) - _compute_positions(clip, frames), axis=-1)
    moving = moved[:, 0] * clip.fps > 0.01
    return bool(moving.any() and np.median(moved[moving].min(1) / moved[moving, 0]) < 0.5)


def _spread_frames(count: int) -> np.ndarray:
    return np.arange(count)[:: max(1, -(-count // SAMPLES))]


def _compute_positions(clip: Clip, frames: np.ndarray) -> np.ndarray:
    """Compute joint positions (n, 22, 3), metres, world, of some frames on the built-in body."""
    rest, poses = make_builtin_rest_joints(), clip.poses[frames]
    local = Rotation.from_rotvec(poses.reshape(-1, 3)).as_matrix().reshape(*poses.shape, 3)
    rotations, positions = [local[:, 0]], [clip.trans[frames] + rest[0]]
    for joint, parent in enumerate(PARENTS[1:], start=1):
        positions.append(positions[parent] + rotations[parent] @ (rest[joint] - rest[parent]))
        rotations.append(rotations[parent] @ local[:, joint])
    return np.stack(positions, 1)


MOST_FRAMES = 5 * 60 * FPS  # the rest of a longer clip is not checked
SEGMENTS = (  # ends of body segments, and their fractions of the mass (Winter, Biomechanics, 2009)
    ("neck", "head", 0.081), ("pelvis", "neck", 0.497),
    *((f"{side}_{start}", f"{side}_{end}", mass) for side in ("left", "right") for start, end, mass in (
        ("shoulder", "elbow", 0.028), ("elbow", "wrist", 0.022), ("hip", "knee", 0.1),
        ("knee", "ankle", 0.0465), ("ankle", "foot", 0.0145),
    )),
)  # fmt: skip

STEP, FEWEST = 0.5, 4  # metres and number: shorter or fewer steps show no rate
SWINGING = 0.15  # a foot swings above this fraction of its fast speed (95 % quantile)
SLOWEST_SWING = 0.05  # m/s
RUNNING = 0.35  # a walker's other foot moves in less than this fraction of a swing
SHORTEST_SWINGS = 0.30, 0.22  # seconds, walking and running; measured: 0.33 and 0.25
LONGEST_SWING = 1.15  # seconds; measured: 0.95

GRAVITY = 9.81  # m/s^2
RAISED = 0.06  # metres of all joints above their usual lowest place in a flight
FLIGHT, RISE, MISFIT = 0.1, 0.02, 0.05  # seconds and metres at least; deviation from a parabola per height
FLIGHTS = 2
MOST_GRAVITY, SLOW_GRAVITY = 2.5, (0.15, 0.4)  # multiples of gravity; measured in flights: 0.6 to 1.8

HIP_LINE_SPEED, TURNS = 0.15, 0.3  # m/s of the hip line, and seconds with such turns
SLIDING = 2.0  # ratio of the feet's speed to that with exchanged legs; measured: 1.6


def find_dynamic_faults(positions: np.ndarray, fps: float, clip_fps: float) -> Iterator[str]:
    """Yield descriptions of a wrong rate and of exchanged legs, for joint positions (N, 22, 3), metres, world
    (Z up), N > 1, at `fps`. Messages name the clip's rate `clip_fps`."""
    label = f"so the frame rate {clip_fps:g} Hz may be"
    swings = np.array(_measure_swings(positions, fps)).reshape(-1, 3)
    if len(swings) >= FEWEST:
        seconds, metres, shared = np.median(swings, axis=0)
        steps = f"a foot swings {metres:.1f} m in {seconds:.2f} s"
        if seconds < SHORTEST_SWINGS[int(shared >= RUNNING)]:
            yield f"{steps}, faster than people step, {label} about twice the true rate or more"
        elif seconds > LONGEST_SWING:
            yield f"{steps}, slower than people step, {label} about half the true rate or less"
    falls = np.array(_measure_falls(positions, fps))
    if len(falls) >= FLIGHTS:
        jumps = f"the body falls with {np.median(falls):.1f} times the acceleration of gravity"
        low, high = SLOW_GRAVITY
        if falls.min() > MOST_GRAVITY:
            yield f"{jumps}, {label} too high"
        elif low < np.median(falls) < high and falls.max() < 1.5 * high:
            yield f"{jumps}, {label} too low"
    if (ratio := _compare_sliding(positions, fps)) > SLIDING:
        slide = f"the feet slide {ratio:.1f} times as far as with exchanged legs"
        yield f"{slide}, so left and right legs may be swapped"


def _find_runs(is_on: np.ndarray) -> np.ndarray:
    """Return the first frames of runs of true values, and the frames after them (runs, 2)."""
    return np.flatnonzero(np.diff(np.concatenate([[0], is_on.astype(int), [0]]))).reshape(-1, 2)


def _measure_swings(positions: np.ndarray, fps: float) -> list[tuple[float, float, float]]:
    """Return duration, length and the fraction in which the other foot moves, of each whole long swing."""
    feet = (positions[:, ANKLES] + positions[:, TOES]) / 2
    speed = np.linalg.norm(np.gradient(feet, axis=0), axis=-1) * fps
    moving = speed > np.maximum(SWINGING * np.quantile(speed, 0.95, axis=0), SLOWEST_SWING)
    both = moving.all(1)
    return [
        ((end - start) / fps, length, float(both[start:end].mean()))
        for foot in (0, 1)
        for start, end in _find_runs(moving[:, foot])
        if start > 0
        and end < len(feet)
        and (length := float(np.linalg.norm((feet[end - 1] - feet[start])[foot, :2]))) > STEP
    ]


def _measure_falls(positions: np.ndarray, fps: float) -> list[float]:
    """Return the downward acceleration of the centre of mass in each flight, in multiples of gravity."""
    ends = [[JOINTS.index(name) for name in segment[:2]] for segment in SEGMENTS]
    masses = np.array([mass for _, _, mass in SEGMENTS])
    height = positions[:, ends, 2].mean(-1) @ masses / masses.sum()
    lowest = positions[:, :, 2].min(1)
    falls = []
    for start, end in _find_runs(lowest > np.quantile(lowest, 0.05) + RAISED):
        path, seconds = height[start:end], np.arange(end - start) / fps
        if len(path) < 6 or seconds[-1] < FLIGHT or np.ptp(path) < RISE:
            continue
        parabola = np.polyfit(seconds, path, 2)
        if np.std(path - np.polyval(parabola, seconds)) < MISFIT * np.ptp(path):
            falls.append(float(-2 * parabola[0] / GRAVITY))
    return falls


def _compare_sliding(positions: np.ndarray, fps: float) -> float:
    """Return the speed of the slower foot while the pelvis turns, relative to that with exchanged legs."""
    hips, toes = positions[:, HIPS], positions[:, TOES]
    turning = np.linalg.norm(np.diff(hips[:, 0] - hips[:, 1], axis=0), axis=-1) * fps > HIP_LINE_SPEED
    if turning.sum() < TURNS * fps:
        return 0.0

    def measure_speed(feet: np.ndarray) -> float:
        speed = np.linalg.norm(np.diff(feet[:, :, :2], axis=0), axis=-1).min(1) * fps
        return float(np.median(speed[turning]))

    return measure_speed(toes) / (measure_speed(hips[:, ::-1] + toes - hips) + 1e-3)
