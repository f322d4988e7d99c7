"""A person controlled by feet, pelvis, trunk, gaze and hands. Inverse kinematics computes the joints.

The body's axes are SMPL's: x left, y up, z forward. Angles about these axes are pitch, yaw and roll. Positive
angles lean forward, turn left, and lean to the right. Curves are arrays (N,) over the times t (N,), in
seconds.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.ndimage import convolve1d, maximum_filter1d, minimum_filter1d
from scipy.spatial.transform import Rotation

from memmlp.motion.body import JOINTS, N_JOINTS, make_builtin_rest_joints

Array = np.ndarray

REST = make_builtin_rest_joints()
INDEX = {name: joint for joint, name in enumerate(JOINTS)}
SIDES = (("left", 1.0), ("right", -1.0))
ANKLE_HEIGHT = 0.075  # metres above the floor, with a flat foot
HEEL = np.array([0.0, -ANKLE_HEIGHT, -0.05])  # metres: vector from the ankle to the heel's contact point
STRETCH = 0.993  # maximum fraction of its full length to which a standing leg stretches
SPINE_SHARES = {"spine1": 0.3, "spine2": 0.3, "spine3": 0.4}
LEG_POLE, ARM_POLE = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])  # bends of knee and elbow in T-pose


# Smooth functions of time


def make_ease(t: Array, start: float, end: float) -> Array:
    """Return a curve (N,) that rises from 0 at `start` to 1 at `end` with minimum jerk."""
    s = np.clip((t - start) / (end - start), 0.0, 1.0)
    return s * s * s * (10.0 - s * (15.0 - 6.0 * s))


def make_pulse(t: Array, start: float, top: float, leave: float, end: float) -> Array:
    """Return a curve (N,): 0 at `start`, rising to 1 at `top`, falling from `leave` to 0 at `end`."""
    return make_ease(t, start, top) - make_ease(t, leave, end)


def make_glide(t: Array, start: float, end: float) -> Array:
    """Return a curve (N,) that rises from 0 at `start` to 1 at `end` with constant speed in the middle. It
    accelerates at the start and slows down at the end, each for 30 % of the time."""
    ramp = 0.3

    def ramped(x: Array) -> Array:  # the integral of `make_ease` from 0 to 1
        c = np.clip(x, 0.0, 1.0)
        return c**4 * (2.5 - c * (3.0 - c)) + np.maximum(x - 1.0, 0.0)

    s = np.clip((t - start) / (end - start), 0.0, 1.0)
    return (ramped(s / ramp) - ramped((s - 1.0) / ramp + 1.0)) * ramp / (1.0 - ramp)


def make_arc(t: Array, start: float, end: float) -> Array:
    """Return a curve (N,) that is 1 in the middle of [start, end] and falls smoothly to 0 at both ends."""
    s = make_glide(t, start, end)
    return 4.0 * s * (1.0 - s)


def make_wander(
    rng: np.random.Generator, t: Array, shape: tuple[int, ...] = (), low: float = 0.1, high: float = 1.0
) -> Array:
    """Return random variation (N, *shape) with RMS 1: independent sums of six sines of `low` to `high` Hz."""
    size = (6, *shape)
    frequency = np.exp(rng.uniform(np.log(low), np.log(high), size))
    amplitude = rng.uniform(0.5, 1.0, size) / np.sqrt(frequency)
    amplitude *= np.sqrt(2.0 / (amplitude**2).sum(0))
    start = rng.uniform(0.0, 2 * np.pi, size)
    time = t.reshape(-1, *([1] * len(shape)))
    result = np.zeros((len(t), *shape))
    for wave in range(6):
        result += amplitude[wave] * np.sin(2 * np.pi * frequency[wave] * time + start[wave])
    return result


def smooth(x: Array, frames: int) -> Array:
    """Return a weighted moving average (N, ...) over 2 * `frames` + 1 frames."""
    kernel = np.hanning(2 * frames + 3)[1:-1] ** 2
    return convolve1d(x, kernel / kernel.sum(), axis=0, mode="nearest")


def smooth_below(x: Array, frames: int) -> Array:
    """Return a smooth curve (N,) that is never above `x`: the moving average of the running minimum."""
    return smooth(minimum_filter1d(x, 2 * frames + 1, mode="nearest"), frames)


def compute_soft_minimum(a: Array, b: Array, width: float) -> Array:
    """Return a smooth curve below both `a` and `b`. The distance to their minimum is at most `width` / 2, and
    smaller if `a` and `b` differ more."""
    return 0.5 * (a + b - np.sqrt((a - b) ** 2 + width**2))


# Feet


@dataclass(frozen=True)
class FootStep:
    """A step of one foot; seconds, metres, radians."""

    foot: int  # 0 left, 1 right
    off: float  # time when the toes leave the floor
    on: float  # time when the heel touches the floor again
    to: Array  # target position (2,) on the floor below the ankle, world
    yaw: float  # direction of the foot after the step, world
    lift: float = 0.05  # maximum height of the foot
    heel: float = 0.4  # angle of the raised heel when the toes leave the floor
    toe: float = 0.1  # angle of the raised toes when the heel touches the floor
    push: float = 0.15  # time from the heel's rise to `off`
    roll: float = 0.1  # time from `on` until the toes touch the floor


@dataclass
class Feet:
    """Both feet over N frames, left and right."""

    ground: Array  # positions (N, 2, 3) below the ankles of flat feet, metres, world; z is 0 on the floor
    yaw: Array  # directions (N, 2), radians, world
    heel: Array  # rotation angles (N, 2) about the ball of the foot, radians, at least 0
    toe: Array  # rotation angles (N, 2) about the heel, radians, at least 0
    planted: Array  # whether ball or heel is on the floor (N, 2)


def apply_foot_steps(t: Array, places: Array, yaws: Array, steps: Iterable[FootStep]) -> Feet:
    """Return the motion of both feet at the times t (N,) for steps sorted by time, from start positions (2,
    2), metres, and directions (2,), radians, in the world."""
    n = len(t)
    ground = np.zeros((n, 2, 3))
    ground[:, :, :2] = places
    feet = Feet(ground, np.tile(yaws, (n, 1)), np.zeros((n, 2)), np.zeros((n, 2)), np.ones((n, 2), bool))
    place, yaw = np.array(places, float), np.array(yaws, float)
    for step in steps:
        foot, off, on = step.foot, step.off, step.on
        part = make_glide(t, off, on)
        ground[:, foot, :2] += part[:, None] * (step.to - place[foot])
        ground[:, foot, 2] += step.lift * make_arc(t, off, on)
        feet.yaw[:, foot] += part * (step.yaw - yaw[foot])
        feet.heel[:, foot] += step.heel * make_pulse(t, off - step.push, off, off, off + 0.7 * (on - off))
        feet.toe[:, foot] += step.toe * make_pulse(t, on - 0.5 * (on - off), on, on, on + step.roll)
        feet.planted[:, foot] &= (t <= off) | (t >= on)
        place[foot], yaw[foot] = step.to, step.yaw
    return feet


# The person


@dataclass
class Puppet:
    """The controls of a person in N frames; metres, radians."""

    fps: float  # frames per second
    heading: Array  # direction (N,) of the body: 0 is world +X, pi/2 is +Y
    # position (N, 3) of the root, world; it is lowered if a standing leg does not reach the floor
    pelvis: Array
    settle: float  # seconds over which the pelvis is lowered
    tilt: Array  # rotation vector (N, 3) of the pelvis relative to the heading
    spine: Array  # rotation vector (N, 3) of the chest relative to the pelvis
    gaze: Array  # pitch and yaw (N, 2) of the head relative to the heading
    feet: Feet
    # positions (N, 2, 3) of the wrists relative to the shoulders: outward, up, forward in trunk axes
    hands: Array
    wrists: Array  # rotation vectors (N, 2, 3) of the left wrist and of the mirrored right wrist


def solve_joints(puppet: Puppet) -> tuple[Array, Array]:
    """Compute axis-angle poses (N, 22, 3), radians, and root positions (N, 3), metres, world."""
    pelvis = make_facing_rotation(puppet.heading) * Rotation.from_rotvec(puppet.tilt)
    root = _compute_root(puppet, pelvis)
    local = {"pelvis": pelvis}
    for side in (0, 1):
        local |= _solve_leg(puppet, side, pelvis, root)
    chest = pelvis
    for name, fraction in SPINE_SHARES.items():
        local[name] = Rotation.from_rotvec(fraction * puppet.spine)
        chest = chest * local[name]
    gaze = make_facing_rotation(puppet.heading + puppet.gaze[:, 1]) * _make_pitch_rotation(puppet.gaze[:, 0])
    half = Rotation.from_rotvec(0.5 * (chest.inv() * gaze).as_rotvec())
    local |= {"neck": half, "head": half}  # neck and head each do half of the rotation to the gaze
    for side in (0, 1):
        local |= _solve_arm(puppet, side, chest)
    poses = np.zeros((len(root), N_JOINTS, 3))
    for name, rotation in local.items():
        poses[:, INDEX[name]] = rotation.as_rotvec()
    return poses, root


def make_facing_rotation(yaw: Array) -> Rotation:
    """Return the rotations (N) from body axes to the world for an upright person, given `yaw` (N,)."""
    upright = Rotation.from_rotvec([np.pi / 2, 0.0, 0.0])
    return Rotation.from_rotvec(np.outer(yaw + np.pi / 2, [0.0, 0.0, 1.0])) * upright


def solve_two_bones(
    start: Array,
    target: Array,
    pole: Array,
    bones: tuple[Array, Array],
    rest_pole: Array,
    free: Array | float,
) -> tuple[Rotation, Rotation]:
    """Return the global rotations (N) of two bones from `start` (N, 3) to `target` (N, 3), or as near as
    possible. The joint between them points to `pole` (N, 3), in the rest pose, where the bones are (3,), to
    `rest_pole` (3,). `free` (N,), in [0, 1], is how early a stretching limb slows down; with 0 it reaches
    targets exactly, up to nearly its full length."""
    upper, lower = bones
    a, b = float(np.linalg.norm(upper)), float(np.linalg.norm(lower))
    span = np.linalg.norm(target - start, axis=-1, keepdims=True)
    along = (target - start) / span
    reach = np.maximum(_limit_reach(span, a + b, free), 0.28 * (a + b))
    across = pole - (pole * along).sum(-1, keepdims=True) * along
    across = across / np.linalg.norm(across, axis=-1, keepdims=True)
    cosine = (a * a + reach * reach - b * b) / (2 * a * reach)
    middle = a * (cosine * along + np.sqrt(1 - cosine * cosine) * across)
    hinge = np.cross(across, along)
    return (
        _align_bone(upper, np.cross(rest_pole, upper), middle, hinge),
        _align_bone(lower, np.cross(rest_pole, lower), reach * along - middle, hinge),
    )


def compute_ankle(feet: Feet, side: int) -> tuple[Array, Rotation]:
    """Compute the ankle's position (N, 3), world, and the foot's global rotation (N)."""
    name = SIDES[side][0]
    ball = _get_bone(f"{name}_ankle", f"{name}_foot")
    heel_up, toe_up = _make_pitch_rotation(feet.heel[:, side]), _make_pitch_rotation(-feet.toe[:, side])
    moved = ball - heel_up.apply(ball) + HEEL - toe_up.apply(HEEL) + [0.0, ANKLE_HEIGHT, 0.0]
    flat = make_facing_rotation(feet.yaw[:, side])
    return feet.ground[:, side] + flat.apply(moved), flat * heel_up * toe_up


def _compute_root(puppet: Puppet, pelvis: Rotation) -> Array:
    """Compute the root's position (N, 3), lowered if a standing leg would be stretched too far."""
    height = puppet.pelvis[:, 2]
    ceiling = height + 0.3
    frames = round(puppet.settle * puppet.fps)
    for side, (name, _) in enumerate(SIDES):
        hip = pelvis.apply(_get_bone("pelvis", f"{name}_hip"))
        away = compute_ankle(puppet.feet, side)[0] - puppet.pelvis - hip
        length = STRETCH * _measure_chain(f"{name}_hip", f"{name}_knee", f"{name}_ankle")
        reach = np.sqrt(np.maximum(length**2 - (away[:, :2] ** 2).sum(-1), 0.0))
        limit = height + away[:, 2] + reach
        carries = _lengthen_steps(puppet.feet.planted[:, side], frames // 2)
        ceiling = np.where(carries, np.minimum(ceiling, limit), ceiling)
    root = puppet.pelvis.copy()
    root[:, 2] = compute_soft_minimum(height, smooth_below(ceiling, frames), 0.01)
    return root


def _solve_leg(puppet: Puppet, side: int, pelvis: Rotation, root: Array) -> dict[str, Rotation]:
    """Return the local rotations of a leg's hip, knee, ankle and foot. The knee points in the mean direction
    of pelvis and foot."""
    name, sign = SIDES[side]
    ankle, foot = compute_ankle(puppet.feet, side)
    frames = round(puppet.settle * puppet.fps) // 2
    ahead = make_facing_rotation(puppet.feet.yaw[:, side]).apply([0, 0, 1.0])
    pole = pelvis.apply([0.1 * sign, 0, 1.0]) + ahead
    hip = root + pelvis.apply(_get_bone("pelvis", f"{name}_hip"))
    bones = _get_bone(f"{name}_hip", f"{name}_knee"), _get_bone(f"{name}_knee", f"{name}_ankle")
    free = smooth(1.0 - _lengthen_steps(puppet.feet.planted[:, side], frames), frames)
    thigh, shin = solve_two_bones(hip, ankle, pole, bones, LEG_POLE, free)
    return {
        f"{name}_hip": pelvis.inv() * thigh,
        f"{name}_knee": thigh.inv() * shin,
        f"{name}_ankle": shin.inv() * foot,
        f"{name}_foot": _make_pitch_rotation(-0.5 * puppet.feet.heel[:, side]),
    }


def _solve_arm(puppet: Puppet, side: int, chest: Rotation) -> dict[str, Rotation]:
    """Compute the local rotations of collar, shoulder, elbow and wrist. The collar follows the hand."""
    name, sign = SIDES[side]
    shoulder = _get_bone("spine3", f"{name}_collar"), _get_bone(f"{name}_collar", f"{name}_shoulder")
    bones = _get_bone(f"{name}_shoulder", f"{name}_elbow"), _get_bone(f"{name}_elbow", f"{name}_wrist")
    hand = puppet.hands[:, side] / _measure_chain(f"{name}_shoulder", f"{name}_elbow", f"{name}_wrist")
    raised, forward = 0.11 * (1 + hand[:, 1]).clip(0) ** 2, 0.2 * hand[:, 2]
    collar = chest * Rotation.from_rotvec(sign * np.stack([np.zeros_like(raised), -forward, raised], -1))
    trunk = make_facing_rotation(puppet.heading + puppet.tilt[:, 1] + puppet.spine[:, 1])
    mirror = np.array([sign, 1.0, 1.0])
    start = chest.apply(shoulder[0]) + collar.apply(shoulder[1])
    target = chest.apply(sum(shoulder)) + trunk.apply(puppet.hands[:, side] * mirror)
    ahead = 0.5 + 0.5 * np.tanh(2.0 * (hand[:, 2] - 0.35))
    # The elbow points back if the hand hangs, and down if the hand is ahead.
    pole = trunk.apply(np.stack([np.full_like(ahead, 0.35), -0.9 * ahead, -0.9 * (1.0 - ahead)], -1) * mirror)
    upper, lower = solve_two_bones(start, target, pole, bones, ARM_POLE, 0.0)
    return {
        f"{name}_collar": chest.inv() * collar,
        f"{name}_shoulder": collar.inv() * upper,
        f"{name}_elbow": upper.inv() * lower,
        f"{name}_wrist": Rotation.from_rotvec(puppet.wrists[:, side] * [1.0, sign, sign]),
    }


def _lengthen_steps(planted: Array, frames: int) -> Array:
    """Return whether a foot is planted at most `frames` frames before or after each frame (N,)."""
    return maximum_filter1d(planted, 2 * frames + 1, mode="nearest")


def _limit_reach(span: Array, full: float, free: Array | float) -> Array:
    """Limit a limb's reach (N, 1), so the limb is never completely straight. Above about STRETCH of the full
    length, the reach smoothly approaches 99.9 % of the full length. With a larger `free`, the limit begins
    earlier."""
    start = (STRETCH - 0.05 * np.reshape(free, (-1, 1))) * full
    margin = 0.999 * full - start
    return np.where(span < start, span, start + margin * np.tanh((span - start) / margin))


def _align_bone(rest: Array, rest_hinge: Array, bone: Array, hinge: Array) -> Rotation:
    """Return the rotations (N) from a rest bone and its hinge axis (3,) to a bone and hinge axis (N, 3)."""
    return Rotation.from_matrix(_build_axes(bone, hinge) @ _build_axes(rest, rest_hinge).T)


def _build_axes(bone: Array, hinge: Array) -> Array:
    """Return orthonormal axes (..., 3, 3) in columns: bone, hinge axis, and their cross product."""
    first, second = (v / np.linalg.norm(v, axis=-1, keepdims=True) for v in (bone, hinge))
    return np.stack([first, second, np.cross(first, second)], -1)


def _make_pitch_rotation(angle: Array) -> Rotation:
    """Return rotations (N) about the body's x axis; positive angles lean forward."""
    return Rotation.from_rotvec(np.outer(angle, [1.0, 0.0, 0.0]))


def _get_bone(parent: str, child: str) -> Array:
    """Return a bone in the rest pose (3,), child minus parent, metres."""
    return REST[INDEX[child]] - REST[INDEX[parent]]


def _measure_chain(*chain: str) -> float:
    return float(sum(np.linalg.norm(_get_bone(a, b)) for a, b in pairwise(chain)))
