"""Anatomy: the body's segments, checks whether a pose is a stance, and joint rotations in a stance.

A stance is the pose of a person who stands upright. All positions (..., 22, 3) are in metres, with Y up.
`mapped` (22,) is true for the joints that a file has.
"""

from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from memmlp.motion.body import HEAD, JOINTS, PARENTS

CHAINS = ((0, 3, 6, 9, 12, 15), (1, 4, 7, 10), (2, 5, 8, 11), (13, 16, 18, 20), (14, 17, 19, 21))
HIPS, SHOULDERS = (1, 2), (16, 17)  # left, right
LIMBS = {1: 4, 2: 5, 4: 7, 5: 8, 16: 18, 17: 19, 18: 20, 19: 21}  # joint -> the end of its bone
LEGS = {joint: end for joint, end in LIMBS.items() if joint < 6}
FEET = {7: 10, 8: 11}
SPINE = (3, 6, 9, 12)
HINGES = {1: (1.0, 0.0, 0.0), 2: (1.0, 0.0, 0.0), 16: (0.0, -1.0, 0.0), 17: (0.0, 1.0, 0.0)}
"""Hip or shoulder -> the bending axis of the knee or elbow below it, in the body's rest pose."""

LEFT, UP = np.eye(3)[:2]
LEG_LENGTH = (0.55, 1.15)  # metres from hip to ankle in adults
TRUNK, THIGHS, SHINS = 45.0, 60.0, 75.0  # degrees: maximum angles from the vertical, including running
LEVEL = 30.0  # degrees: maximum angle between the hip line and the horizontal in a stance
ARMS = 100.0  # degrees: maximum angle between an arm's bone and its T-pose direction in a zero pose
SHORTEST = 1e-3  # metres
BENT = 15.0  # degrees: minimum bend of a knee or elbow that shows its axis in a stance
HINGE_BEND, HINGE_AGREEMENT = 0.1, 0.8  # minimum mean and range of the bend's sine, and agreement of its axes


class Segment(NamedTuple):
    """The line from a mapped joint to the next mapped joint of a chain. The first joint rotates it."""

    start: int
    end: int

    def __str__(self) -> str:
        return f"{JOINTS[self.start]} to {JOINTS[self.end]}"


def list_segments(mapped: np.ndarray) -> tuple[Segment, ...]:
    """Return the segments between mapped joints in trunk, neck, arms, legs and feet."""
    chains = [[joint for joint in chain if mapped[joint]] for chain in CHAINS]
    return tuple(Segment(*pair) for chain in chains for pair in pairwise(chain))


def compute_angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the angles (...), degrees, between directions (..., 3). They are accurate at 0."""
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(-1)))


def normalize_vectors(vectors: np.ndarray) -> np.ndarray:
    """Scale vectors (..., 3) to length 1."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def compute_least_rotation(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Compute the smallest rotations (..., 3, 3) from directions `source` to directions `target` (..., 3). A
    direction of length zero gives the identity. Opposite directions give a half turn about some perpendicular
    axis."""
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


def align_directions(
    first: tuple[np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """Compute the rotation (3, 3) that aligns one direction exactly, and a second one as far as possible.
    Each argument is a pair of a direction and its target direction."""
    (a, to_a), (b, to_b) = first, second
    once = compute_least_rotation(a, to_a)
    axis = normalize_vectors(to_a)
    turned, goal = (v - (v @ axis) * axis for v in (once @ b, to_b))
    angle = np.arctan2(np.cross(turned, goal) @ axis, turned @ goal)
    return Rotation.from_rotvec(angle * axis).as_matrix() @ once


# Checks whether a pose is a stance


def find_stance_fault(pose: np.ndarray) -> str | None:
    """Return why a pose (22, 3) is not a stance, regardless of facing direction, left and right; None for a
    stance."""
    for start, end in ((0, HEAD), *LIMBS.items()):
        if np.linalg.norm(pose[end] - pose[start]) < SHORTEST:
            return f"{JOINTS[start]} and {JOINTS[end]} are at the same place"
    across = pose[HIPS[0]] - pose[HIPS[1]]
    if np.linalg.norm(across) < SHORTEST:
        return "the hips are at the same place"
    for start, end, along, max_angle in _list_vertical_segments():
        angle = compute_angles(pose[end] - pose[start], along)
        if angle > max_angle:
            direction = "up" if along is UP else "down"
            return f"{JOINTS[start]} to {JOINTS[end]} points {angle:.0f} degrees away from {direction}"
    tilt = abs(90 - compute_angles(across, UP))
    if tilt > LEVEL:
        return f"the hip line is {tilt:.0f} degrees from horizontal"
    for hip in HIPS:
        axis = find_bend_axis(pose, hip)
        if axis is not None and axis @ across < 0:
            knee = JOINTS[LIMBS[hip]]
            return f"{knee} bends forward, so left and right may be swapped, or leg joints may be wrong"
    return None


def find_side_fault(pose: np.ndarray, mapped: np.ndarray) -> str | None:
    """Return how a stance (22, 3) contradicts its left and right; None without a contradiction."""
    left = pose[HIPS[0]] - pose[HIPS[1]]
    if (pose[SHOULDERS[0]] - pose[SHOULDERS[1]]) @ left < 0:
        return "the left shoulder is on the side of the right hip"
    feet = [pose[toes] - pose[ankle] for ankle, toes in FEET.items() if mapped[ankle] and mapped[toes]]
    if feet and normalize_vectors(np.mean(feet, axis=0)) @ normalize_vectors(np.cross(left, UP)) < 0:
        return "the feet point backward, so left and right may be swapped"
    return None


def has_raised_arm(pose: np.ndarray) -> bool:
    """Return whether an arm points far from its T-pose direction in a stance (22, 3) that faces +Z."""
    ends = ((16, 18, LEFT), (18, 20, LEFT), (17, 19, -LEFT), (19, 21, -LEFT))
    return any(compute_angles(pose[end] - pose[start], along) > ARMS for start, end, along in ends)


def measure_unevenness(poses: np.ndarray) -> np.ndarray:
    """Measure how far poses (N, 22, 3) differ from a straight stance: sums of angles (N,), degrees."""
    vertical = _list_vertical_segments()
    total = sum(compute_angles(poses[:, end] - poses[:, start], along) for start, end, along, _ in vertical)
    left, across = (poses[:, a] - poses[:, b] for a, b in (HIPS, SHOULDERS))
    arms = ((16, 18, 20), (17, 19, 21))
    bends = [compute_angles(poses[:, e] - poses[:, m], poses[:, m] - poses[:, s]) for s, m, e in arms]
    return total + np.abs(90 - compute_angles(left, UP)) + compute_angles(left, across) + 0.5 * sum(bends)


def find_facing_turn(pose: np.ndarray) -> np.ndarray:
    """Find the rotation (3, 3) about the vertical that makes a stance (22, 3) face +Z, with left on +X."""
    left = pose[HIPS[0]] - pose[HIPS[1]]
    return Rotation.from_rotvec(np.arctan2(left[2], left[0]) * UP).as_matrix()


def _list_vertical_segments() -> Iterator[tuple[int, int, np.ndarray, float]]:
    yield 0, HEAD, UP, TRUNK
    for start, end in LEGS.items():
        yield start, end, -UP, THIGHS if start in HIPS else SHINS


# Joint rotations in a stance


def compute_orientations(stance: np.ndarray, mapped: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Compute the rotations (22, 3, 3) that pose a body with rest joints (22, 3) like a stance (22, 3) that
    faces +Z. Every segment has its direction in the stance. The twist of the pelvis follows the hips, the
    twist of the chest follows the shoulders, and the spine is between them. Upper limbs get the smallest
    rotation from the rest pose, lower limbs from the upper limbs. The head is upright and faces in the
    direction of the chest. Wrists and toes have the rotation of their parents."""

    def is_long(start: int, end: int) -> bool:
        return bool(np.linalg.norm(stance[end] - stance[start]) > SHORTEST)

    result = np.tile(np.eye(3), (len(JOINTS), 1, 1))
    ends = {segment.start: segment.end for segment in list_segments(mapped)}
    hips, shoulders = (normalize_vectors(stance[left] - stance[right]) for left, right in (HIPS, SHOULDERS))
    chest = align_directions((UP, UP), (LEFT, shoulders))
    trunk = next(end for end in (*SPINE, HEAD) if is_long(0, end) and mapped[end])
    up = rest[trunk] - rest[0], stance[trunk] - stance[0]
    result[0] = align_directions((rest[1] - rest[2], hips), up)
    for step, joint in enumerate(SPINE, start=1):
        left = normalize_vectors(hips + min(step / 3, 1.0) * (shoulders - hips))
        result[joint] = align_directions((UP, UP), (LEFT, left))
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
            result[joint] = compute_least_rotation(bone, stance[end] - stance[joint]) @ result[joint]
    return result


def find_bend_axis(stance: np.ndarray, joint: int) -> np.ndarray | None:
    """Find the bending axis (3,) of the knee or elbow below a hip or shoulder in a stance (22, 3); None if
    the limb is straight."""
    middle, end = LIMBS[joint], LIMBS[LIMBS[joint]]
    upper, lower = stance[middle] - stance[joint], stance[end] - stance[middle]
    return normalize_vectors(np.cross(upper, lower)) if compute_angles(upper, lower) > BENT else None


def find_hinge_axis(upper: np.ndarray, positions: np.ndarray, joint: int) -> np.ndarray | None:
    """Find the bending axis (3,) of the knee or elbow below a hip or shoulder (one of `HINGES`) from the
    motion, in the frame of thigh or upper arm, whose global rotations (N, 3, 3) are `upper`; None if the limb
    bends too little or about different axes."""
    middle, end = LIMBS[joint], LIMBS[LIMBS[joint]]
    bones = np.diff(positions[:, [joint, middle, end]], axis=1)
    bends = np.einsum("nij,ni->nj", upper, np.cross(*normalize_vectors(bones).swapaxes(0, 1)))
    total, sizes = bends.sum(0), np.linalg.norm(bends, axis=-1)
    bent = min(sizes.mean(), np.ptp(sizes)) > HINGE_BEND
    agreeing = np.linalg.norm(total) > HINGE_AGREEMENT * sizes.sum()
    return normalize_vectors(total) if bent and agreeing else None
