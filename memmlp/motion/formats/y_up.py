"""The body's motion in a world whose Y axis points up, as formats of animation programs need it."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from memmlp.motion.body import N_JOINTS
from memmlp.motion.clip import Clip

Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # from AMASS' world: (x, y, z) becomes (x, z, -y)


def y_up_motion(clip: Clip, rest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return local rotations (N, 22, 3, 3), the root's global, and the root's positions (N, 3), metres.

    The world is right-handed with Y up, as SMPL's body frame is: where all rotations are the identity the
    person stands in T-pose, upright, and faces +Z. A rest pose (22, 3), metres, needs no conversion.
    """
    rotations = Rotation.from_rotvec(clip.poses.reshape(-1, 3)).as_matrix().reshape(-1, N_JOINTS, 3, 3)
    rotations[:, 0] = Y_UP @ rotations[:, 0]
    return rotations, (rest[0] + clip.trans) @ Y_UP.T
