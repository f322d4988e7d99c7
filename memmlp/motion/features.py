"""From motion to frames [X | Theta]: the 54 inputs and the 198 targets of the networks."""

from __future__ import annotations

import torch
from torch import Tensor

from memmlp.motion.body import TRACKED
from memmlp.motion.geometry import axis_angle_to_matrix, forward_kinematics, matrix_to_sixd


def sparse_features(rotations: Tensor, positions: Tensor) -> Tensor:
    """Compute the inputs X of three trackers (AvatarPoser's features, Sec. 3.1 of the paper).

    Args:
        rotations: global rotations of head, left and right wrist (N, 3, 3, 3).
        positions: their global positions (N, 3, 3), metres.

    Returns:
        (N - 1, 54), feature-major as `memmlp.motion.body.SPARSE_*`. Frame 0 has no velocity and is dropped.
    """
    angular = rotations[:-1].transpose(-1, -2) @ rotations[1:]
    parts = [
        matrix_to_sixd(rotations[1:]),
        matrix_to_sixd(angular),
        positions[1:],
        positions[1:] - positions[:-1],
    ]
    return torch.cat([part.flatten(1) for part in parts], 1)


def motion_frames(poses: Tensor, trans: Tensor, rest: Tensor) -> Tensor:
    """Compute the frames [X | Theta] (N - 1, 252) of a clip, world.

    Args:
        poses: axis-angle (N, 22, 3), the root's global.
        trans: translation (N, 3), metres; the root joint is at rest[0] + trans.
        rest: rest positions (22, 3), metres.
    """
    local = axis_angle_to_matrix(poses)
    rotations, positions = forward_kinematics(local, trans + rest[0], rest)
    tracked = list(TRACKED)
    sparse = sparse_features(rotations[:, tracked], positions[:, tracked])
    theta = torch.cat([matrix_to_sixd(local).flatten(1), positions.flatten(1)], 1)
    return torch.cat([sparse, theta[1:]], 1)
