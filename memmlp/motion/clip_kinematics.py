"""Forward kinematics of a clip: where the joints of a body are that moves as the clip does."""

from __future__ import annotations

import numpy as np
import torch

from memmlp.motion.clip import Clip
from memmlp.motion.geometry import axis_angle_to_matrix, forward_kinematics


def clip_kinematics(clip: Clip, rest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return global rotations (N, 22, 3, 3) and positions (N, 22, 3), metres, world, of a clip on a body.

    Args:
        clip: the motion.
        rest: the body's rest joints (22, 3), metres.
    """
    local = axis_angle_to_matrix(torch.from_numpy(clip.poses))
    joints = torch.from_numpy(rest)
    rotations, positions = forward_kinematics(local, joints[0] + torch.from_numpy(clip.trans), joints)
    return rotations.numpy(), positions.numpy()
