"""The stance from which a file's skeleton is read, with all of its nodes, and the body in the same stance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from memmlp.motion.body import JOINTS, PARENTS
from memmlp.motion.importing import anatomy
from memmlp.motion.importing.axes import with_unit_and_up
from memmlp.motion.importing.mapped_motion import MappedMotion, pick_joints
from memmlp.motion.importing.motion_file import MotionFile
from memmlp.motion.importing.reading_stance import Stance, find_stance
from memmlp.motion.importing.retarget import fit
from memmlp.motion.importing.skeleton_map import SkeletonMap


@dataclass(frozen=True)
class StanceWithAllNodes:
    """A person who stands and faces +Z, Y up, left on +X, in metres; the root is where the file has it.

    Attributes:
        nodes: the nodes' names; parents: the index of each node's parent, -1 for the root.
        positions: the nodes' positions (nodes, 3).
        mapped: body joint -> index of its node.
        body: the body's joints (22, 3) in the same stance, the pelvis at the origin.
        source: which pose of the file it is, in words.
    """

    nodes: tuple[str, ...]
    parents: tuple[int, ...]
    positions: np.ndarray
    mapped: dict[str, int]
    body: np.ndarray
    source: str


def find_stance_with_all_nodes(
    recording: MotionFile, skeleton: SkeletonMap, rest: np.ndarray
) -> StanceWithAllNodes:
    """Return the stance from which `import` reads a file's skeleton.

    Args:
        recording: the file's motion.
        skeleton: the file's skeleton map, with the nodes spelt as in the file.
        rest: the body's rest joints (22, 3), metres.

    Raises:
        InputError: as importing does: if no person stands in the file, or the map does not fit it.
    """
    settled = with_unit_and_up(recording, skeleton)
    mapped_motion = pick_joints(recording, settled)
    stance = find_stance(recording, settled, mapped_motion)
    turned = stance.rotations @ fit(recording, settled, mapped_motion, rest).corrections
    mapped = {joint: int(mapped_motion.nodes[JOINTS.index(joint)]) for joint in skeleton.joints}
    positions = _all_nodes(recording, settled, mapped_motion, stance)
    return StanceWithAllNodes(
        recording.nodes, recording.node_parents, positions, mapped, _posed(turned, rest), stance.source
    )


def _all_nodes(
    recording: MotionFile, skeleton: SkeletonMap, mapped_motion: MappedMotion, stance: Stance
) -> np.ndarray:
    """Return the positions (nodes, 3) of all nodes in a pose that is known for the mapped nodes only.

    The pose is looked up among the zero pose, the map's pose and the frames, by the mapped nodes' heights.
    """
    given = skeleton.rest if isinstance(skeleton.rest, dict) else {}
    frames = recording.kinematics()[1][int(skeleton.calibration_frame) :]
    assert skeleton.unit is not None
    poses = np.concatenate([recording.zero_pose()[None], recording.posed(given)[1][None], frames])
    poses = skeleton.unit * poses @ skeleton.upright.T
    off = np.abs(poses[:, mapped_motion.nodes, 1] - stance.positions[:, 1]).max(1)
    best = poses[off.argmin()]
    return best @ anatomy.facing(best[mapped_motion.nodes]).T


def _posed(rotations: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Return the joints (22, 3) of a body whose joints have these global rotations (22, 3, 3)."""
    positions = np.zeros_like(rest)
    for joint, parent in enumerate(PARENTS):
        if joint:
            positions[joint] = positions[parent] + rotations[parent] @ (rest[joint] - rest[parent])
    return positions
