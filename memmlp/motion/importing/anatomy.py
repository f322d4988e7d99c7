"""Anatomy: the body's segments, tests of whether a pose is a stance, and the joints' rotations in a stance.

A stance is the pose of a person who stands upright. All positions (..., 22, 3) here are in Y-up axes and
metres. `mapped` (22,) says which joints a file has.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from memmlp.motion.body import HEAD, JOINTS, PARENTS

CHAINS = ((0, 3, 6, 9, 12, 15), (1, 4, 7, 10), (2, 5, 8, 11), (13, 16, 18, 20), (14, 17, 19, 21))
HIPS, SHOULDERS = (1, 2), (16, 17)  # left, right
LIMBS = {1: 4, 2: 5, 4: 7, 5: 8, 16: 18, 17: 19, 18: 20, 19: 21}  # joint -> the other end of its bone
LEGS = {joint: end for joint, end in LIMBS.items() if joint < 6}
FEET = {7: 10, 8: 11}
SPINE = (3, 6, 9, 12)
HINGES = {1: (1.0, 0.0, 0.0), 2: (1.0, 0.0, 0.0), 16: (0.0, -1.0, 0.0), 17: (0.0, 1.0, 0.0)}
"""Thighs and upper arms -> the axis about which the joint at their end bends, in the body's rest pose."""

LEFT, UP = np.eye(3)[:2]
LEG_LENGTH = (0.55, 1.15)  # metres from hip to ankle of adults
TRUNK, THIGHS, SHINS = 45.0, 60.0, 75.0  # degrees: largest angles from the vertical in a stance, a runner's
LEVEL = 30.0  # degrees: largest angle of the line of the hips from the horizontal in a stance
ARMS = 100.0  # degrees: largest angle of an upper arm or forearm from a T-pose's in a zero pose
SHORTEST = 1e-3  # metres
BENT = 15.0  # degrees by which a knee or elbow must bend in a stance to show its axis
HINGE_BEND, HINGE_AGREEMENT = 0.1, 0.8  # least mean sine of the bend, and agreement of its axes, in motion


class Segment(NamedTuple):
    """The straight line from a joint to the next joint of its chain in the file. The first joint turns it."""

    start: int
    end: int

    def __str__(self) -> str:
        return f"{JOINTS[self.start]} to {JOINTS[self.end]}"


def segments(mapped: np.ndarray) -> tuple[Segment, ...]:
    """Return the segments of trunk, neck, arms, legs and feet between mapped joints."""
    chains = [[joint for joint in chain if mapped[joint]] for chain in CHAINS]
    return tuple(Segment(*pair) for chain in chains for pair in pairwise(chain))


def angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the angles (...), degrees, between directions (..., 3); accurate at 0."""
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(-1)))


def unit(vectors: np.ndarray) -> np.ndarray:
    """Return vectors (..., 3) with length 1."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def least_rotation(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the smallest rotations (..., 3, 3) that turn directions (..., 3) onto others.

    For a direction without length, the identity is returned. Opposite directions are carried onto each other
    by a half turn about one of the axes perpendicular to them.
    """
    axis, along = np.cross(source, target), (source * target).sum(-1, keepdims=True)
    norm = np.linalg.norm(axis, axis=-1, keepdims=True)
    opposite = (norm == 0) & (along < 0)
    across = np.cross(source, np.eye(3)[np.abs(source).argmin(-1)])
    length = np.linalg.norm(across, axis=-1, keepdims=True)
    across = np.divide(across, length, out=np.zeros_like(across), where=length > 0)
    axis, norm = np.where(opposite, across, axis), np.where(opposite, 1.0, norm)
    angle = np.where(opposite, np.pi, np.arctan2(norm, along))
    turn = axis * np.divide(angle, norm, out=np.zeros_like(norm), where=norm > 0)
    return Rotation.from_rotvec(turn.reshape(-1, 3)).as_matrix().reshape(*turn.shape, 3)


def align(first: tuple[np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Return the rotation (3, 3) that aligns one direction exactly, and then another as far as possible.

    Each argument is a pair: a direction, and the direction onto which it is turned.
    """
    (a, to_a), (b, to_b) = first, second
    once = least_rotation(a, to_a)
    axis = unit(to_a)
    turned, goal = (v - (v @ axis) * axis for v in (once @ b, to_b))
    angle = np.arctan2(np.cross(turned, goal) @ axis, turned @ goal)
    return Rotation.from_rotvec(angle * axis).as_matrix() @ once


# Whether a pose is a stance


def why_no_stance(pose: np.ndarray) -> str | None:
    """Return why nobody stands upright in a pose (22, 3); None if somebody does.

    The direction that the person faces, and left and right, do not matter here.
    """
    for start, end in ((0, HEAD), *LIMBS.items()):
        if np.linalg.norm(pose[end] - pose[start]) < SHORTEST:
            return f"{JOINTS[start]} and {JOINTS[end]} are at the same place"
    across = pose[HIPS[0]] - pose[HIPS[1]]
    if np.linalg.norm(across) < SHORTEST:
        return "the hips are at the same place"
    for start, end, along, most in _verticals():
        angle = angles(pose[end] - pose[start], along)
        if angle > most:
            direction = "up" if along is UP else "down"
            return f"{JOINTS[start]} to {JOINTS[end]} is {angle:.0f} degrees from {direction}"
    tilt = abs(90 - angles(across, UP))
    if tilt > LEVEL:
        return f"the line of the hips is {tilt:.0f} degrees from level"
    for hip in HIPS:
        axis = bend(pose, hip)
        if axis is not None and axis @ across < 0:
            knee = JOINTS[LIMBS[hip]]
            return f"{knee} bends forward: left and right, or the joints of the leg, may be wrong"
    return None


def wrong_sides(pose: np.ndarray, mapped: np.ndarray) -> str | None:
    """Return a contradiction about left and forward in a stance (22, 3); None without one."""
    left = pose[HIPS[0]] - pose[HIPS[1]]
    if (pose[SHOULDERS[0]] - pose[SHOULDERS[1]]) @ left < 0:
        return "the left shoulder is on the side of the right hip"
    feet = [pose[toes] - pose[ankle] for ankle, toes in FEET.items() if mapped[ankle] and mapped[toes]]
    if feet and unit(np.mean(feet, axis=0)) @ unit(np.cross(left, UP)) < 0:
        return "the feet point backward, so left and right may be swapped"
    return None


def arms_lifted(pose: np.ndarray) -> bool:
    """Return whether an arm of a stance that faces +Z (22, 3) is far from a T-pose's."""
    ends = ((16, 18, LEFT), (18, 20, LEFT), (17, 19, -LEFT), (19, 21, -LEFT))
    return any(angles(pose[end] - pose[start], along) > ARMS for start, end, along in ends)


def unevenness(poses: np.ndarray) -> np.ndarray:
    """Return how far poses (N, 22, 3) are from standing straight, as sums of angles (N,), degrees."""
    total = sum(angles(poses[:, end] - poses[:, start], along) for start, end, along, _ in _verticals())
    left, across = (poses[:, a] - poses[:, b] for a, b in (HIPS, SHOULDERS))
    arms = ((16, 18, 20), (17, 19, 21))
    bends = [angles(poses[:, e] - poses[:, m], poses[:, m] - poses[:, s]) for s, m, e in arms]
    return total + np.abs(90 - angles(left, UP)) + angles(left, across) + 0.5 * sum(bends)


def facing(pose: np.ndarray) -> np.ndarray:
    """Return the turn (3, 3) about the vertical after which a stance (22, 3) has its left on +X."""
    left = pose[HIPS[0]] - pose[HIPS[1]]
    return Rotation.from_rotvec(np.arctan2(left[2], left[0]) * UP).as_matrix()


def _verticals() -> Iterator[tuple[int, int, np.ndarray, float]]:
    """Yield the segments that are vertical in a stance, their direction, and the tolerance in degrees."""
    yield 0, HEAD, UP, TRUNK
    for start, end in LEGS.items():
        yield start, end, -UP, THIGHS if start in HIPS else SHINS


# The joints' rotations in a stance


def orientations(stance: np.ndarray, mapped: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Return the rotations (22, 3, 3) of a body's joints that make it stand as in a stance (22, 3) facing +Z.

    Every segment points as in the stance. About its own axis, the pelvis follows the hips, the chest the
    shoulders, and the spine both. Upper limbs take the smallest rotation from the body's rest pose (22, 3),
    lower limbs the smallest rotation from the upper ones. The head is upright and faces in the direction of
    the chest. Wrists and toes continue straight.
    """

    def is_long(start: int, end: int) -> bool:
        return bool(np.linalg.norm(stance[end] - stance[start]) > SHORTEST)

    result = np.tile(np.eye(3), (len(JOINTS), 1, 1))
    ends = {segment.start: segment.end for segment in segments(mapped)}
    hips, shoulders = (unit(stance[left] - stance[right]) for left, right in (HIPS, SHOULDERS))
    chest = align((UP, UP), (LEFT, shoulders))
    trunk = next(end for end in (*SPINE, HEAD) if is_long(0, end) and mapped[end])
    result[0] = align((rest[1] - rest[2], hips), (rest[trunk] - rest[0], stance[trunk] - stance[0]))
    for step, joint in enumerate(SPINE, start=1):
        left = unit(hips + min(step / 3, 1.0) * (shoulders - hips))
        result[joint] = align((UP, UP), (LEFT, left))
    result[HEAD] = chest
    for joint in range(1, len(JOINTS)):
        parent = PARENTS[joint]
        if joint in (4, 5, 18, 19) or not mapped[joint]:
            result[joint] = result[parent]
        elif joint in (13, 14, 16, 17):
            result[joint] = chest
        end = ends.get(joint)
        if end is None:
            result[joint] = result[joint] if joint == HEAD else result[parent]
        elif is_long(joint, end):
            bone = result[joint] @ (rest[end] - rest[joint])
            result[joint] = least_rotation(bone, stance[end] - stance[joint]) @ result[joint]
    return result


def bend(stance: np.ndarray, joint: int) -> np.ndarray | None:
    """Return the axis (3,) of a knee or elbow that is bent in a stance (22, 3); None if it is straight."""
    middle, end = LIMBS[joint], LIMBS[LIMBS[joint]]
    upper, lower = stance[middle] - stance[joint], stance[end] - stance[middle]
    return unit(np.cross(upper, lower)) if angles(upper, lower) > BENT else None


def hinge(upper: np.ndarray, positions: np.ndarray, joint: int) -> np.ndarray | None:
    """Find the bending axis of the joint at the end of a thigh or upper arm, from the motion.

    Args:
        upper: global rotations (N, 3, 3) of the thigh or upper arm.
        positions: the joints' positions (N, 22, 3).
        joint: the joint that turns the thigh or upper arm, one of `HINGES`.

    Returns:
        The axis (3,) in the thigh's or upper arm's own frame; None if it bends too little, or about too many
        axes.
    """
    middle, end = LIMBS[joint], LIMBS[LIMBS[joint]]
    bones = unit(positions[:, middle] - positions[:, joint]), unit(positions[:, end] - positions[:, middle])
    bends = np.einsum("nij,ni->nj", upper, np.cross(*bones))
    total, sizes = bends.sum(0), np.linalg.norm(bends, axis=-1)
    is_clear = sizes.mean() > HINGE_BEND and np.linalg.norm(total) > HINGE_AGREEMENT * sizes.sum()
    return unit(total) if is_clear else None
