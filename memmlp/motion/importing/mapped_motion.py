"""The motion of the 22 body joints that a skeleton map picks from a recording."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from memmlp.common.errors import InputError
from memmlp.motion.body import JOINTS, PARENTS
from memmlp.motion.importing.motion_file import MotionFile
from memmlp.motion.importing.skeleton_map import SkeletonMap


@dataclass(frozen=True)
class MappedMotion:
    """A recording's motion of the mapped joints, in Y-up axes and metres.

    Attributes:
        path: the file, for messages.
        mapped: whether (22,) each body joint has a node in the file.
        nodes: index (22,) of that node; without one, that of the parent joint's node.
        rotations: global rotations (N, 22, 3, 3) of these nodes.
        positions: their positions (N, 22, 3).
        zero: their positions (22, 3) in the file's zero pose, where all rotations are the identity.
    """

    path: Path
    mapped: np.ndarray
    nodes: np.ndarray
    rotations: np.ndarray
    positions: np.ndarray
    zero: np.ndarray

    def __len__(self) -> int:
        return len(self.rotations)


def pick_joints(recording: MotionFile, skeleton: SkeletonMap) -> MappedMotion:
    """Pick the mapped joints' motion from a recording, without its calibration frame.

    Raises:
        InputError: if nodes that the map names are missing or stand in another order than the body's, or no
            frame is left.
    """
    nodes = _nodes(recording, skeleton)
    rotations, positions = (
        array[int(skeleton.calibration_frame) :, nodes] for array in recording.kinematics()
    )
    if len(rotations) == 0:
        raise InputError(f"{recording.path}: only the calibration frame; allowed: two frames or more")
    upright, unit = skeleton.upright, skeleton.unit
    return MappedMotion(
        path=recording.path,
        mapped=np.array([joint in skeleton.joints for joint in JOINTS]),
        nodes=nodes,
        rotations=upright @ rotations @ upright.T,
        positions=unit * positions @ upright.T,
        zero=unit * recording.zero_pose()[nodes] @ upright.T,
    )


def _nodes(recording: MotionFile, skeleton: SkeletonMap) -> np.ndarray:
    """Return the index (22,) of each body joint's node; a joint without a node has its parent's."""
    missing = sorted(set(skeleton.joints.values()) - set(recording.nodes))
    if missing:
        lacking = f"no {', '.join(missing)}, which skeleton {skeleton.name} names"
        raise InputError(f"{recording.path}: {lacking}; allowed: a map of the file's joints")
    nodes = np.zeros(len(JOINTS), int)
    for joint, parent in enumerate(PARENTS):
        node = skeleton.joints.get(JOINTS[joint])
        nodes[joint] = nodes[parent] if node is None else recording.nodes.index(node)
        if nodes[parent] not in _line(recording, nodes[joint]):
            wrong = (
                f"{node} is not below {recording.nodes[nodes[parent]]}, as skeleton {skeleton.name} has it"
            )
            raise InputError(f"{recording.path}: {wrong}; allowed: a map of the file's tree")
    return nodes


def _line(recording: MotionFile, node: int) -> list[int]:
    """Return the node and its ancestors."""
    line = [node]
    while recording.node_parents[line[-1]] >= 0:
        line.append(recording.node_parents[line[-1]])
    return line
