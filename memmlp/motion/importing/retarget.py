"""Retargets BVH motion to clips on the 22-joint tree, by a skeleton map.

A source joint's global rotation, carried from the file's axes to the world (Z up), is the rotation of the
body joint it is mapped to, up to a constant correction K on the right: the bone that points along t in the
body's rest pose points along s = K t in the source's zero pose. Arms and legs get the least rotation from t
to s, so that they point as in the source in every frame. Wrists, ankles and feet move on with the bone before
them. The torso and the head stand upright in both poses and need no correction. A body joint without a
counterpart takes its parent's rotation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from memmlp.common.errors import InputError
from memmlp.motion.body import JOINTS, PARENTS
from memmlp.motion.clip import Clip
from memmlp.motion.formats.bvh import Bvh
from memmlp.motion.importing.skeleton import HIPS, LEGS, LIMBS, Z_UP, SkeletonMap

FOLLOWERS = (7, 8, 10, 11, 20, 21)  # they keep the correction of the bone before them
ZERO_POSE_LIMIT = 100.0  # degrees between a limb in the source's zero pose and in the T-pose
POSITION_LIMIT = 1e4  # metres, as `read_clip` has it


@dataclass(frozen=True)
class Retargeting:
    """What is constant between one BVH hierarchy and one body, in Y-up axes and metres.

    Attributes:
        nodes: index (22,) of the BVH node whose rotation each body joint takes; a joint without a node takes
            its parent's.
        corrections: K (22, 3, 3), on the right of the node's rotation.
        own_rest: rest positions (22, 3) of the source's own bones, in the corrected joint frames.
        scale: the body's leg length over the source's.
        anchor: from the scaled source root to the body's root (3,), in the root's frame; it makes the middle
            of the hips the same in both, since a source's root may lie above or below SMPL's pelvis.
    """

    nodes: np.ndarray
    corrections: np.ndarray
    own_rest: np.ndarray
    scale: float
    anchor: np.ndarray


def fit(bvh: Bvh, skeleton: SkeletonMap, rest: np.ndarray) -> Retargeting:
    """Fit a BVH hierarchy to a body's rest joints (22, 3), metres.

    Raises:
        InputError: if joints are missing or stand in another order than the body's, or the zero pose is not
            an upright pose of a person whose bones have a length.
    """
    nodes = _nodes(bvh, skeleton)
    zero = (bvh.zero_pose() @ skeleton.upright.T * skeleton.unit)[nodes]
    _check_zero_pose(bvh.path, zero, rest)
    corrections = _corrections(zero, rest)
    scale = _leg_length(rest) / _leg_length(zero)
    anchor = scale * (zero[HIPS, :].mean(0) - zero[0]) - (rest[HIPS, :].mean(0) - rest[0])
    return Retargeting(nodes, corrections, _own_rest(zero, corrections), scale, anchor)


def retarget(
    bvh: Bvh, skeleton: SkeletonMap, rest: np.ndarray, *, name: str = "bvh", fps: float | None = None
) -> Clip:
    """Retarget a BVH file's motion to a body, in the world (Z up).

    Args:
        bvh: the file; a calibration frame is dropped.
        skeleton: its skeleton map.
        rest: the body's rest joints (22, 3), metres.
        name: the clip's name.
        fps: the true frame rate, Hz; by default the header's.

    Raises:
        InputError: as `fit` does, and if no frame is left or the person is more than 10 km from the origin.
    """
    fitted = fit(bvh, skeleton, rest)
    world = Z_UP @ skeleton.upright
    rotations, positions = (array[int(skeleton.calibration_frame) :] for array in bvh.kinematics())
    if len(rotations) == 0:
        raise InputError(f"{bvh.path}: only the calibration frame; allowed: two frames or more")
    turned = world @ rotations[:, fitted.nodes] @ (skeleton.upright.T @ fitted.corrections)
    root = fitted.scale * skeleton.unit * positions[:, fitted.nodes[0]] @ world.T
    trans = root + turned[:, 0] @ fitted.anchor - rest[0]
    if np.abs(trans).max() > POSITION_LIMIT:
        far = f"{np.abs(trans).max():.3g} m from the origin with the unit of {skeleton.name}"
        raise InputError(f"{bvh.path}: {far}; allowed: {POSITION_LIMIT:g} m")
    local = turned.copy()
    local[:, 1:] = turned[:, list(PARENTS[1:])].swapaxes(-1, -2) @ turned[:, 1:]
    poses = Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec().reshape(len(local), len(JOINTS), 3)
    return Clip(name, poses, trans, fps or bvh.fps)


def _nodes(bvh: Bvh, skeleton: SkeletonMap) -> np.ndarray:
    """Return the index (22,) of each body joint's node; its parent's where it has none."""
    missing = sorted(set(skeleton.joints.values()) - set(bvh.nodes))
    if missing:
        lacking = f"no {', '.join(missing)}, which skeleton {skeleton.name} names"
        raise InputError(f"{bvh.path}: {lacking}; allowed: a map of the file's joints")
    nodes = np.zeros(len(JOINTS), int)
    for joint, parent in enumerate(PARENTS):
        node = skeleton.joints.get(JOINTS[joint])
        nodes[joint] = nodes[parent] if node is None else bvh.nodes.index(node)
        if nodes[parent] not in _line(bvh, nodes[joint]):
            wrong = f"{node} is not below {bvh.nodes[nodes[parent]]}, as skeleton {skeleton.name} has it"
            raise InputError(f"{bvh.path}: {wrong}; allowed: a map of the file's tree")
    return nodes


def _line(bvh: Bvh, node: int) -> list[int]:
    """Return the node and its ancestors."""
    line = [node]
    while bvh.node_parents[line[-1]] >= 0:
        line.append(bvh.node_parents[line[-1]])
    return line


def _check_zero_pose(path: Path, zero: np.ndarray, rest: np.ndarray) -> None:
    """Raise InputError unless each limb has a length and points roughly as in the T-pose."""
    for joint, child in LIMBS.items():
        bone = zero[child] - zero[joint]
        angle = math.degrees(limb_angles(bone, rest[child] - rest[joint]))
        if np.linalg.norm(bone) < 1e-3 or angle > ZERO_POSE_LIMIT:
            wrong = f"{JOINTS[joint]} to {JOINTS[child]} is {np.linalg.norm(bone):.3g} m in the zero pose"
            allowed = "a zero pose that stands upright, faces forward and has its left on +X"
            raise InputError(f"{path}: {wrong}, {angle:.0f} degrees off a T-pose; allowed: {allowed}")


def _corrections(zero: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Return K (22, 3, 3) from positions (22, 3) in the source's zero pose and in the body's rest pose."""
    corrections = np.tile(np.eye(3), (len(JOINTS), 1, 1))
    for joint, child in LIMBS.items():
        corrections[joint] = _least_rotation(rest[child] - rest[joint], zero[child] - zero[joint])
    for joint in FOLLOWERS:
        corrections[joint] = corrections[PARENTS[joint]]
    return corrections


def _least_rotation(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return the smallest rotation (3, 3) of one direction (3,) onto another that is not its opposite."""
    axis = np.cross(source, target)
    norm = np.linalg.norm(axis)
    angle = math.atan2(norm, source @ target)
    return Rotation.from_rotvec(axis * (angle / norm) if norm else axis).as_matrix()


def _own_rest(zero: np.ndarray, corrections: np.ndarray) -> np.ndarray:
    """Return rest positions (22, 3) on which corrected rotations put the joints where the source has them."""
    own = zero.copy()
    for joint, parent in enumerate(PARENTS[1:], start=1):
        own[joint] = own[parent] + corrections[parent].T @ (zero[joint] - zero[parent])
    return own


def _leg_length(positions: np.ndarray) -> float:
    """Return the length of thigh and shin of positions (22, 3), the mean of both sides."""
    return (
        sum(float(np.linalg.norm(positions[child] - positions[joint])) for joint, child in LEGS.items()) / 2
    )


def limb_angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the angles (...), radians, between directions (..., 3); accurate at 0."""
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(-1))
