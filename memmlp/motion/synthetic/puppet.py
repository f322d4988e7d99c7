"""A person driven by feet, pelvis, trunk, gaze and hands; the joints follow by inverse kinematics.

Directions of the body are SMPL's: x left, y up, z forward. Angles about them are (pitch, yaw, roll): positive
leans forward, turns left, leans to the right. Curves are arrays over times of N frames, in seconds.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.ndimage import convolve1d, maximum_filter1d, minimum_filter1d
from scipy.spatial.transform import Rotation

from memmlp.motion.body import JOINTS, N_JOINTS, builtin_rest_joints

Array = np.ndarray

REST = builtin_rest_joints()
INDEX = {name: joint for joint, name in enumerate(JOINTS)}
SIDES = (("left", 1.0), ("right", -1.0))
ANKLE_HEIGHT = 0.075  # metres above the floor, foot flat
HEEL = np.array([0.0, -ANKLE_HEIGHT, -0.05])  # from the ankle to the heel's contact
STRETCH = 0.993  # a leg that carries is no longer than this part of its full length
SPINE_SHARES = {"spine1": 0.3, "spine2": 0.3, "spine3": 0.4}
LEG_POLE, ARM_POLE = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0])  # knee and elbow in T-pose


# Smooth functions of time


def ease(t: Array, start: float, end: float) -> Array:
    """Return (N,): 0 before `start`, 1 after `end`, minimum jerk between."""
    s = np.clip((t - start) / (end - start), 0.0, 1.0)
    return s * s * s * (10.0 - s * (15.0 - 6.0 * s))


def pulse(t: Array, start: float, top: float, leave: float, end: float) -> Array:
    """Return (N,): 0, rising from `start` to 1 at `top`, falling from `leave` to 0 at `end`."""
    return ease(t, start, top) - ease(t, leave, end)


def glide(t: Array, start: float, end: float, ramp: float = 0.3) -> Array:
    """Return (N,): as `ease`, but at an even speed between two ramps that take `ramp` of the time each."""

    def ramped(x: Array) -> Array:  # the integral of an ease from 0 to 1
        c = np.clip(x, 0.0, 1.0)
        return c**4 * (2.5 - c * (3.0 - c)) + np.maximum(x - 1.0, 0.0)

    s = np.clip((t - start) / (end - start), 0.0, 1.0)
    return (ramped(s / ramp) - ramped((s - 1.0) / ramp + 1.0)) * ramp / (1.0 - ramp)


def arc(t: Array, start: float, end: float) -> Array:
    """Return (N,): 0 outside [start, end], 1 in the middle, velocity and acceleration 0 at both ends."""
    s = glide(t, start, end)
    return 4.0 * s * (1.0 - s)


def wander(
    rng: np.random.Generator, t: Array, shape: tuple[int, ...] = (), low: float = 0.1, high: float = 1.0
) -> Array:
    """Return natural variation (N, *shape) of RMS 1: independent sums of six sines of `low` to `high` Hz."""
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
    """Return the moving average (N, ...) under a bell of 2 * `frames` + 1 frames."""
    kernel = np.hanning(2 * frames + 3)[1:-1] ** 2
    return convolve1d(x, kernel / kernel.sum(), axis=0, mode="nearest")


def smooth_below(x: Array, frames: int) -> Array:
    """Return a smooth curve (N,) that is nowhere above `x`: the running minimum's average under the bell."""
    return smooth(minimum_filter1d(x, 2 * frames + 1, mode="nearest"), frames)


def soft_minimum(a: Array, b: Array, width: float) -> Array:
    """Return a smooth curve below both `a` and `b`.

    It is within `width` / 2 of their minimum, and nearer where they differ more.
    """
    return 0.5 * (a + b - np.sqrt((a - b) ** 2 + width**2))


# Feet


@dataclass(frozen=True)
class FootStep:
    """One step of one foot; seconds, metres, radians."""

    foot: int  # 0 left, 1 right
    off: float  # when the toes leave the floor
    on: float  # when the heel touches the floor again
    to: Array  # position (2,) on the floor below the ankle, world
    yaw: float  # direction of the foot after the step, world
    lift: float = 0.05  # how high the foot is lifted on the way
    heel: float = 0.4  # angle by which the heel is up when the toes leave
    toe: float = 0.1  # angle by which the toes are up when the heel arrives
    push: float = 0.15  # how long before `off` the heel rises
    roll: float = 0.1  # how long after `on` the toes come down


@dataclass
class Feet:
    """Both feet over N frames, left and right."""

    ground: Array  # position (N, 2, 3) of the flat foot, below the ankle, metres, world; z is 0 on the floor
    yaw: Array  # direction (N, 2), radians, world
    heel: Array  # angle (N, 2), radians, at least 0, by which the foot is turned about its ball
    toe: Array  # angle (N, 2), radians, at least 0, by which it is turned about its heel
    planted: Array  # whether (N, 2) ball or heel are on the floor


def tread(t: Array, places: Array, yaws: Array, steps: Iterable[FootStep]) -> Feet:
    """Return feet that make steps in order of time.

    Args:
        t: times (N,), seconds.
        places: where (2, 2) the feet start, metres, world.
        yaws: their directions (2,) there, radians, world.
        steps: the steps, in order of time.
    """
    n = len(t)
    ground = np.zeros((n, 2, 3))
    ground[:, :, :2] = places
    feet = Feet(ground, np.tile(yaws, (n, 1)), np.zeros((n, 2)), np.zeros((n, 2)), np.ones((n, 2), bool))
    place, yaw = np.array(places, float), np.array(yaws, float)
    for step in steps:
        foot, off, on = step.foot, step.off, step.on
        part = glide(t, off, on)
        ground[:, foot, :2] += part[:, None] * (step.to - place[foot])
        ground[:, foot, 2] += step.lift * arc(t, off, on)
        feet.yaw[:, foot] += part * (step.yaw - yaw[foot])
        feet.heel[:, foot] += step.heel * pulse(t, off - step.push, off, off, off + 0.7 * (on - off))
        feet.toe[:, foot] += step.toe * pulse(t, on - 0.5 * (on - off), on, on, on + step.roll)
        feet.planted[:, foot] &= (t <= off) | (t >= on)
        place[foot], yaw[foot] = step.to, step.yaw
    return feet


# The person


@dataclass
class Puppet:
    """The controls of a person over N frames; metres, radians."""

    fps: float  # frames per second
    heading: Array  # direction (N,) the body faces: 0 is world +X, pi/2 is +Y
    # position (N, 3) of the root, world; it is lowered if a standing leg would not reach the foot
    pelvis: Array
    settle: float  # seconds over which the pelvis is lowered
    tilt: Array  # rotation vector (N, 3) of the pelvis against the heading
    spine: Array  # rotation vector (N, 3) of the chest against the pelvis
    gaze: Array  # (pitch, yaw) (N, 2) of the head against the heading
    feet: Feet  # the feet
    # wrists (N, 2, 3) from the shoulders at rest: outward, up, forward in the turned, upright trunk
    hands: Array
    wrists: Array  # rotation vectors (N, 2, 3) of the left wrist, and of the right one as its mirror image


def solve(puppet: Puppet) -> tuple[Array, Array]:
    """Return axis-angle poses (N, 22, 3), radians, and root positions (N, 3), metres, world."""
    pelvis = facing(puppet.heading) * Rotation.from_rotvec(puppet.tilt)
    root = _root(puppet, pelvis)
    local = {"pelvis": pelvis}
    for side in (0, 1):
        local |= _leg(puppet, side, pelvis, root)
    chest = pelvis
    for name, share in SPINE_SHARES.items():
        local[name] = Rotation.from_rotvec(share * puppet.spine)
        chest = chest * local[name]
    gaze = facing(puppet.heading + puppet.gaze[:, 1]) * _pitch(puppet.gaze[:, 0])
    half = Rotation.from_rotvec(0.5 * (chest.inv() * gaze).as_rotvec())
    local |= {"neck": half, "head": half}  # which share the turn from the chest to the gaze
    for side in (0, 1):
        local |= _arm(puppet, side, chest)
    poses = np.zeros((len(root), N_JOINTS, 3))
    for name, rotation in local.items():
        poses[:, INDEX[name]] = rotation.as_rotvec()
    return poses, root


def facing(yaw: Array) -> Rotation:
    """Return the rotation from the body's axes to the world for an upright person who faces `yaw` (N,)."""
    upright = Rotation.from_rotvec([np.pi / 2, 0.0, 0.0])
    return Rotation.from_rotvec(np.outer(yaw + np.pi / 2, [0.0, 0.0, 1.0])) * upright


def two_bone(
    start: Array,
    target: Array,
    pole: Array,
    bones: tuple[Array, Array],
    rest_pole: Array,
    free: Array | float,
) -> tuple[Rotation, Rotation]:
    """Return the global rotations (N) of two bones that go from `start` to `target`.

    Args:
        start: positions (N, 3).
        target: positions (N, 3); a position out of reach is approached as far as the bones go.
        pole: directions (N, 3) to which the joint between the bones points.
        bones: the two bones (3,) in the rest pose.
        rest_pole: direction (3,) to which the joint between the bones points in the rest pose.
        free: in [0, 1] (N,): how early a limb that is being stretched slows down; with 0 it reaches exactly,
            up to nearly its full length.
    """
    upper, lower = bones
    a, b = float(np.linalg.norm(upper)), float(np.linalg.norm(lower))
    span = np.linalg.norm(target - start, axis=-1, keepdims=True)
    along = (target - start) / span
    reach = np.maximum(_within(span, a + b, free), 0.28 * (a + b))
    across = pole - (pole * along).sum(-1, keepdims=True) * along
    across = across / np.linalg.norm(across, axis=-1, keepdims=True)
    cosine = (a * a + reach * reach - b * b) / (2 * a * reach)
    middle = a * (cosine * along + np.sqrt(1 - cosine * cosine) * across)
    hinge = np.cross(across, along)
    return (
        _carry(upper, np.cross(rest_pole, upper), middle, hinge),
        _carry(lower, np.cross(rest_pole, lower), reach * along - middle, hinge),
    )


def ankles(feet: Feet, side: int) -> tuple[Array, Rotation]:
    """Return an ankle's position (N, 3), world, and the foot's global rotation (N)."""
    name = SIDES[side][0]
    ball = _bone(f"{name}_ankle", f"{name}_foot")
    heel_up, toe_up = _pitch(feet.heel[:, side]), _pitch(-feet.toe[:, side])
    moved = ball - heel_up.apply(ball) + HEEL - toe_up.apply(HEEL) + [0.0, ANKLE_HEIGHT, 0.0]
    flat = facing(feet.yaw[:, side])
    return feet.ground[:, side] + flat.apply(moved), flat * heel_up * toe_up


def _root(puppet: Puppet, pelvis: Rotation) -> Array:
    """Return the root (N, 3), lowered if a leg that carries, or is about to, would be stretched out."""
    height = puppet.pelvis[:, 2]
    ceiling = height + 0.3
    frames = round(puppet.settle * puppet.fps)
    for side, (name, _) in enumerate(SIDES):
        hip = pelvis.apply(_bone("pelvis", f"{name}_hip"))
        away = ankles(puppet.feet, side)[0] - puppet.pelvis - hip
        length = STRETCH * _length(f"{name}_hip", f"{name}_knee", f"{name}_ankle")
        reach = np.sqrt(np.maximum(length**2 - (away[:, :2] ** 2).sum(-1), 0.0))
        limit = height + away[:, 2] + reach
        carries = _near(puppet.feet.planted[:, side], frames // 2)
        ceiling = np.where(carries, np.minimum(ceiling, limit), ceiling)
    root = puppet.pelvis.copy()
    root[:, 2] = soft_minimum(height, smooth_below(ceiling, frames), 0.01)
    return root


def _leg(puppet: Puppet, side: int, pelvis: Rotation, root: Array) -> dict[str, Rotation]:
    """Return local rotations of hip, knee, ankle and foot; the knee points where pelvis and foot point."""
    name, sign = SIDES[side]
    ankle, foot = ankles(puppet.feet, side)
    frames = round(puppet.settle * puppet.fps) // 2
    pole = pelvis.apply([0.1 * sign, 0, 1.0]) + facing(puppet.feet.yaw[:, side]).apply([0, 0, 1.0])
    thigh, shin = two_bone(
        root + pelvis.apply(_bone("pelvis", f"{name}_hip")),
        ankle,
        pole,
        (_bone(f"{name}_hip", f"{name}_knee"), _bone(f"{name}_knee", f"{name}_ankle")),
        LEG_POLE,
        smooth(1.0 - _near(puppet.feet.planted[:, side], frames), frames),
    )
    return {
        f"{name}_hip": pelvis.inv() * thigh,
        f"{name}_knee": thigh.inv() * shin,
        f"{name}_ankle": shin.inv() * foot,
        f"{name}_foot": _pitch(-0.5 * puppet.feet.heel[:, side]),
    }


def _arm(puppet: Puppet, side: int, chest: Rotation) -> dict[str, Rotation]:
    """Return local rotations of collar, shoulder, elbow and wrist; the collar goes some way with the hand."""
    name, sign = SIDES[side]
    shoulder = _bone("spine3", f"{name}_collar"), _bone(f"{name}_collar", f"{name}_shoulder")
    bones = _bone(f"{name}_shoulder", f"{name}_elbow"), _bone(f"{name}_elbow", f"{name}_wrist")
    hand = puppet.hands[:, side] / _length(f"{name}_shoulder", f"{name}_elbow", f"{name}_wrist")
    raised, forward = 0.11 * (1 + hand[:, 1]).clip(0) ** 2, 0.2 * hand[:, 2]
    collar = chest * Rotation.from_rotvec(sign * np.stack([np.zeros_like(raised), -forward, raised], -1))
    trunk = facing(puppet.heading + puppet.tilt[:, 1] + puppet.spine[:, 1])
    mirror = np.array([sign, 1.0, 1.0])
    start = chest.apply(shoulder[0]) + collar.apply(shoulder[1])
    target = chest.apply(sum(shoulder)) + trunk.apply(puppet.hands[:, side] * mirror)
    ahead = 0.5 + 0.5 * np.tanh(2.0 * (hand[:, 2] - 0.35))
    # The elbow points back while the hand hangs, and down when it is ahead.
    pole = trunk.apply(np.stack([np.full_like(ahead, 0.35), -0.9 * ahead, -0.9 * (1.0 - ahead)], -1) * mirror)
    upper, lower = two_bone(start, target, pole, bones, ARM_POLE, 0.0)
    return {
        f"{name}_collar": chest.inv() * collar,
        f"{name}_shoulder": collar.inv() * upper,
        f"{name}_elbow": upper.inv() * lower,
        f"{name}_wrist": Rotation.from_rotvec(puppet.wrists[:, side] * [1.0, sign, sign]),
    }


def _near(flags: Array, frames: int) -> Array:
    """Return whether (N,) a flag is set within a number of frames."""
    return maximum_filter1d(flags, 2 * frames + 1, mode="nearest")


def _within(span: Array, full: float, free: Array | float) -> Array:
    """Limit a limb's reach (N, 1) so that the limb never quite straightens.

    Up to about STRETCH of the full length the reach stays unchanged; beyond, it smoothly approaches 99.9 % of
    it. The limit begins earlier if `free` is larger.
    """
    start = (STRETCH - 0.05 * np.reshape(free, (-1, 1))) * full
    margin = 0.999 * full - start
    return np.where(span < start, span, start + margin * np.tanh((span - start) / margin))


def _carry(rest: Array, rest_hinge: Array, bone: Array, hinge: Array) -> Rotation:
    """Return the rotation (N) that takes a bone (3,) and its hinge to those given (N, 3)."""
    return Rotation.from_matrix(_frame(bone, hinge) @ _frame(rest, rest_hinge).T)


def _frame(bone: Array, hinge: Array) -> Array:
    """Return orthonormal axes (..., 3, 3) in columns: the bone, the hinge, and their cross product."""
    first, second = (v / np.linalg.norm(v, axis=-1, keepdims=True) for v in (bone, hinge))
    return np.stack([first, second, np.cross(first, second)], -1)


def _pitch(angle: Array) -> Rotation:
    """Return the rotation (N) about the body's x axis; positive goes forward and down."""
    return Rotation.from_rotvec(np.outer(angle, [1.0, 0.0, 0.0]))


def _bone(parent: str, child: str) -> Array:
    """Return a bone (3,), child minus parent, in the rest pose, metres."""
    return REST[INDEX[child]] - REST[INDEX[parent]]


def _length(*chain: str) -> float:
    """Return the length along a chain of joints, metres."""
    return float(sum(np.linalg.norm(_bone(a, b)) for a, b in pairwise(chain)))
