"""Brings a recording's motion to the 22-joint tree, by a skeleton map.

The global rotation of a file's node is that of the body joint it is mapped to, up to a constant correction on
the right. The corrections come from one pose in which the person stands (`reading_stance`): in that pose the
rotations of the body's joints are known (`anatomy.orientations`), whatever the file's zero pose is. Where an
unmapped joint between two mapped ones turns, the correction is not constant: the segment between them is then
turned by the least rotation to where the file has it. A body joint without a counterpart takes its parent's
rotation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from memmlp.common.errors import InputError
from memmlp.motion.body import JOINTS, PARENTS
from memmlp.motion.clip import Clip
from memmlp.motion.importing import anatomy
from memmlp.motion.importing.anatomy import HINGES, HIPS, LEGS, LIMBS, Segment, least_rotation, segments
from memmlp.motion.importing.mapped_motion import MappedMotion
from memmlp.motion.importing.motion_file import MotionFile
from memmlp.motion.importing.reading_stance import Stance, find_stance
from memmlp.motion.importing.skeleton_map import Z_UP, SkeletonMap

POSITION_LIMIT = 1e4  # metres, as `read_clip` has it
HIP_LINE = Segment(HIPS[1], HIPS[0])


@dataclass(frozen=True)
class Retargeting:
    """The constants that convert a recording's skeleton to a body.

    Attributes:
        corrections: (22, 3, 3), on the right of the rotations of the mapped nodes, in Y-up axes.
        scale: the body's leg length divided by the recording's.
        stance_words: where the corrections are from, in words.
    """

    corrections: np.ndarray
    scale: float
    stance_words: str


def fit(
    recording: MotionFile, skeleton: SkeletonMap, mapped_motion: MappedMotion, rest: np.ndarray
) -> Retargeting:
    """Fit a recording's skeleton to a body's rest joints (22, 3), metres.

    Raises:
        InputError: if no pose is found in which the person stands, or left and right contradict each other.
    """
    stance = find_stance(recording, skeleton, mapped_motion)
    turned = anatomy.orientations(stance.positions, mapped_motion.mapped, rest)
    if not stance.straight:
        turned = _turned_to_hinges(turned, stance, mapped_motion, rest)
    corrections = stance.rotations.swapaxes(-1, -2) @ turned
    scale = float(_leg_length(rest) / np.median(_leg_length(mapped_motion.positions)))
    return Retargeting(corrections, scale, stance.source)


def to_body(
    mapped_motion: MappedMotion, fitted: Retargeting, rest: np.ndarray, name: str, fps: float
) -> Clip:
    """Return mapped motion as a clip on the body that it was fitted to, in the world (Z up).

    The middle of the hips is where the recording has it, scaled by the ratio of leg lengths.

    Args:
        mapped_motion: the recording's mapped joints.
        fitted: what `fit` found.
        rest: the body's rest joints (22, 3), metres.
        name: the clip's name.
        fps: the true frame rate, Hz.

    Raises:
        InputError: if the person is more than 10 km from the origin.
    """
    turned = Z_UP @ _aimed(mapped_motion, mapped_motion.rotations @ fitted.corrections, rest)
    hips = fitted.scale * mapped_motion.positions[:, list(HIPS)].mean(1) @ Z_UP.T
    trans = hips - turned[:, 0] @ (rest[list(HIPS)].mean(0) - rest[0]) - rest[0]
    if np.abs(trans).max() > POSITION_LIMIT:
        far = f"{np.abs(trans).max():.3g} m from the origin"
        raise InputError(f"{mapped_motion.path}: {far}; allowed: {POSITION_LIMIT:g} m")
    local = turned.copy()
    local[:, 1:] = turned[:, list(PARENTS[1:])].swapaxes(-1, -2) @ turned[:, 1:]
    poses = Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec().reshape(len(local), len(JOINTS), 3)
    return Clip(name, poses, trans, fps)


def _aimed(mapped_motion: MappedMotion, turned: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Return rotations (N, 22, 3, 3) whose segments point as in the recording; unmapped joints stay."""
    for start, end in (HIP_LINE, *segments(mapped_motion.mapped)):
        joint = 0 if (start, end) == HIP_LINE else start
        if joint > 0 or (start, end) == HIP_LINE:
            there = mapped_motion.positions[:, end] - mapped_motion.positions[:, start]
            turned[:, joint] = (
                least_rotation(turned[:, joint] @ (rest[end] - rest[start]), there) @ turned[:, joint]
            )
    for joint in map(int, np.flatnonzero(~mapped_motion.mapped)):
        turned[:, joint] = turned[:, PARENTS[joint]]
    return turned


def _turned_to_hinges(
    turned: np.ndarray, stance: Stance, mapped_motion: MappedMotion, rest: np.ndarray
) -> np.ndarray:
    """Turn thighs and upper arms about themselves, so that knees and elbows bend about their axes.

    The axes are found from the stance if the limb is bent in it, otherwise from the motion.
    """
    for joint in HINGES:
        axis = anatomy.bend(stance.positions, joint)
        if axis is None:
            own = anatomy.hinge(mapped_motion.rotations[:, joint], mapped_motion.positions, joint)
            axis = None if own is None else stance.rotations[joint] @ own
        if axis is None:
            continue
        middle = LIMBS[joint]
        turned[joint] = anatomy.turned_to_hinge(turned[joint], joint, rest[middle] - rest[joint], axis)
        end = LIMBS[middle]
        lower = turned[joint] @ (rest[end] - rest[middle])
        there = stance.positions[end] - stance.positions[middle]
        turned[middle] = least_rotation(lower, there) @ turned[joint]
        if end in (20, 21):
            turned[end] = turned[middle]
    return turned


def _leg_length(positions: np.ndarray) -> np.ndarray:
    """Return the lengths (...) of thigh plus shin in positions (..., 22, 3), averaged over both sides."""
    bones = [positions[..., end, :] - positions[..., start, :] for start, end in LEGS.items()]
    return np.linalg.norm(bones, axis=-1).sum(0) / 2
