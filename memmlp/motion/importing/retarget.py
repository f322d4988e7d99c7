"""Brings a recording's motion to the 22-joint tree, by a skeleton map.

The global rotation of a file's node is that of the body joint it is mapped to, up to a constant correction on
the right. The corrections come from one pose in which the person stands, the stance: in it the rotations of
the body's joints are known (`anatomy.orientations`), whatever the file's zero pose is. A zero pose may be a
T-pose, or a pose that no standing person has: bones along one axis, a folded body, a person who lies. Then a
frame of the motion is used, or rotations that the skeleton map gives.

Where an unmapped joint between two mapped ones turns, the correction is not constant: the segment between
them is then turned by the least rotation to its direction in the file. A body joint without a counterpart
takes its parent's rotation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from memmlp.common.errors import InputError
from memmlp.motion.body import JOINTS, PARENTS
from memmlp.motion.clip import Clip
from memmlp.motion.formats.recording import Recording
from memmlp.motion.importing import anatomy
from memmlp.motion.importing.anatomy import HINGES, HIPS, LEGS, LIMBS, Segment, least_rotation, segments
from memmlp.motion.importing.skeleton_map import Z_UP, MappedMotion, SkeletonMap

POSITION_LIMIT = 1e4  # metres, as in `read_clip`
HIP_LINE = Segment(HIPS[1], HIPS[0])
STRAIGHTEST = "the straightest"  # the choice of a frame, beside a given one
TRIED = 500  # frames of a file, evenly spread, among which a stance is looked for


@dataclass(frozen=True)
class Stance:
    """A stance, turned so that the person faces +Z (Y up, metres).

    Attributes:
        rotations: global rotations (22, 3, 3) of the mapped joints' nodes.
        positions: their positions (22, 3).
        nodes: positions (nodes, 3) of all of the file's nodes.
        source: a description of the file's pose.
        straight: whether it is a zero pose, whose limbs are assumed to have no twist.
    """

    rotations: np.ndarray
    positions: np.ndarray
    nodes: np.ndarray
    source: str
    straight: bool


@dataclass(frozen=True)
class Retargeting:
    """The constants that convert a recording's skeleton to a body.

    Attributes:
        corrections: (22, 3, 3), on the right of the rotations of the mapped nodes, in Y-up axes.
        scale: the body's leg length divided by the recording's.
        stance: the pose from which the corrections follow.
    """

    corrections: np.ndarray
    scale: float
    stance: Stance


def find_stance(recording: Recording, skeleton: SkeletonMap, motion: MappedMotion) -> Stance:
    """Find the stance of a file: the map's, else the zero pose, else the straightest frame.

    Raises:
        InputError: if there is no such pose, or left and right contradict each other in it.
    """
    upright, positions, path = skeleton.upright, motion.positions, recording.path

    def stance(rotations: np.ndarray, pose: np.ndarray, nodes: np.ndarray, source: str) -> Stance:
        if (why := anatomy.wrong_sides(pose, motion.mapped)) is not None:
            raise InputError(f"{path}: in {source}, {why}; check left and right in the map, and the up axis")
        turn = anatomy.facing(pose)
        nodes = skeleton.unit * nodes @ upright.T @ turn.T
        return Stance(turn @ rotations, pose @ turn.T, nodes, source, straight=source == "the zero pose")

    def frame_stance(frame: int, how: str) -> Stance:
        nodes = recording.kinematics()[1][frame + int(skeleton.calibration_frame)]
        return stance(motion.rotations[frame], positions[frame], nodes, f"frame {frame}, {how}")

    if isinstance(skeleton.rest, dict):
        rotations, nodes = recording.pose(skeleton.rest)
        pose = skeleton.unit * nodes[motion.nodes] @ upright.T
        if (why := anatomy.why_no_stance(pose)) is not None:
            raise InputError(f"{path}: rest of skeleton {skeleton.name}: {why}; must be an upright stance")
        return stance(upright @ rotations[motion.nodes] @ upright.T, pose, nodes, "the map's rest pose")
    if skeleton.rest != "auto":
        frame = int(skeleton.rest)
        if not 0 <= frame < len(motion):
            raise InputError(f"{path}: rest={frame}: must be a frame from 0 to {len(motion) - 1}")
        if (why := anatomy.why_no_stance(positions[frame])) is not None:
            raise InputError(f"{path}: rest={frame}: {why}; must be a frame in which the person stands")
        return frame_stance(frame, "given")
    why = anatomy.why_no_stance(motion.zero)
    if why is None:
        eyes = np.tile(np.eye(3), (len(motion.zero), 1, 1))
        zero = stance(eyes, motion.zero, recording.zero_pose(), "the zero pose")
        if not anatomy.arms_lifted(zero.positions):
            return zero
        why = "an arm is more than 100 degrees from a T-pose's"
    frames = np.unique(np.linspace(0, len(motion) - 1, TRIED).astype(int))
    order = frames[np.argsort(anatomy.unevenness(positions[frames]), kind="stable")]
    standing = [int(frame) for frame in order if anatomy.why_no_stance(positions[frame]) is None]
    if not standing:
        best = anatomy.why_no_stance(positions[order[0]])
        raise InputError(
            f"{path}: the person stands neither in the zero pose ({why}) nor in any frame (at best, {best}); "
            "check up and joints in the map, or give it a rest"
        )
    sound = (frame for frame in standing if anatomy.wrong_sides(positions[frame], motion.mapped) is None)
    return frame_stance(next(sound, standing[0]), STRAIGHTEST)


def fit(recording: Recording, skeleton: SkeletonMap, motion: MappedMotion, rest: np.ndarray) -> Retargeting:
    """Fit a recording's skeleton to a body's rest joints (22, 3), metres.

    Raises:
        InputError: if no pose is found in which the person stands, or left and right contradict each other.
    """
    stance = find_stance(recording, skeleton, motion)
    turned = anatomy.orientations(stance.positions, motion.mapped, rest)
    if not stance.straight:
        _turn_to_hinges(turned, stance, motion, rest)
    corrections = stance.rotations.swapaxes(-1, -2) @ turned
    scale = float(_leg_length(rest) / np.median(_leg_length(motion.positions)))
    return Retargeting(corrections, scale, stance)


def to_body(motion: MappedMotion, fitted: Retargeting, rest: np.ndarray, name: str, fps: float) -> Clip:
    """Return mapped motion as a clip on the body that it was fitted to, in the world (Z up).

    The middle of the hips is at its place in the recording, scaled by the ratio of leg lengths.

    Args:
        motion: the recording's mapped joints.
        fitted: the result of `fit`.
        rest: the body's rest joints (22, 3), metres.
        name: the clip's name.
        fps: the true frame rate, Hz.

    Raises:
        InputError: if the person is more than 10 km from the origin.
    """
    turned = Z_UP @ _aim_segments(motion, motion.rotations @ fitted.corrections, rest)
    hips = fitted.scale * motion.positions[:, list(HIPS)].mean(1) @ Z_UP.T
    trans = hips - turned[:, 0] @ (rest[list(HIPS)].mean(0) - rest[0]) - rest[0]
    if np.abs(trans).max() > POSITION_LIMIT:
        far = f"{np.abs(trans).max():.3g} m from the origin"
        raise InputError(f"{motion.path}: {far}; must be within {POSITION_LIMIT:g} m")
    local = turned.copy()
    local[:, 1:] = turned[:, list(PARENTS[1:])].swapaxes(-1, -2) @ turned[:, 1:]
    poses = Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec().reshape(len(local), len(JOINTS), 3)
    return Clip(name, poses, trans, fps)


def _aim_segments(motion: MappedMotion, turned: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Return rotations (N, 22, 3, 3) whose segments point as in the recording; unmapped joints stay."""
    for start, end in (HIP_LINE, *segments(motion.mapped)):
        joint = 0 if (start, end) == HIP_LINE else start
        if joint > 0 or (start, end) == HIP_LINE:
            there = motion.positions[:, end] - motion.positions[:, start]
            bone = turned[:, joint] @ (rest[end] - rest[start])
            turned[:, joint] = least_rotation(bone, there) @ turned[:, joint]
    for joint in map(int, np.flatnonzero(~motion.mapped)):
        turned[:, joint] = turned[:, PARENTS[joint]]
    return turned


def _turn_to_hinges(turned: np.ndarray, stance: Stance, motion: MappedMotion, rest: np.ndarray) -> None:
    """Turn thighs and upper arms about themselves, in place, so that knees and elbows bend about their axes.

    The axes are found from the stance if the limb is bent in it, otherwise from the motion.
    """
    for joint, rest_axis in HINGES.items():
        axis = anatomy.bend(stance.positions, joint)
        if axis is None:
            own = anatomy.hinge(motion.rotations[:, joint], motion.positions, joint)
            axis = None if own is None else stance.rotations[joint] @ own
        if axis is None:
            continue
        middle, end = LIMBS[joint], LIMBS[LIMBS[joint]]
        along = turned[joint] @ (rest[middle] - rest[joint])
        turned[joint] = (
            anatomy.align((along, along), (turned[joint] @ np.array(rest_axis), axis)) @ turned[joint]
        )
        lower = turned[joint] @ (rest[end] - rest[middle])
        there = stance.positions[end] - stance.positions[middle]
        turned[middle] = least_rotation(lower, there) @ turned[joint]
        if end in (20, 21):
            turned[end] = turned[middle]


def _leg_length(positions: np.ndarray) -> np.ndarray:
    """Return the lengths (...) of thigh plus shin in positions (..., 22, 3), averaged over both sides."""
    bones = [positions[..., end, :] - positions[..., start, :] for start, end in LEGS.items()]
    return np.linalg.norm(bones, axis=-1).sum(0) / 2
