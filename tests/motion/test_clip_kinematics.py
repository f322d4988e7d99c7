"""The joints of a body that moves as a clip does."""

from __future__ import annotations

import numpy as np

from memmlp.motion.body import builtin_rest_joints
from memmlp.motion.clip import Clip
from memmlp.motion.clip_kinematics import clip_kinematics


def test_a_body_that_is_turned_about_its_pelvis():
    """By a right angle about X in its second frame; the pelvis alone keeps its offset unturned."""
    rest = builtin_rest_joints() + np.array([0.1, 0.2, 0.3])
    poses = np.zeros((2, 22, 3))
    poses[1, 0, 0] = np.pi / 2
    trans = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]])
    rotations, positions = clip_kinematics(Clip("turned", poses, trans, 60.0), rest)
    turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    np.testing.assert_allclose(
        rotations, np.stack([np.tile(each, (22, 1, 1)) for each in (np.eye(3), turn)]), atol=1e-7
    )
    np.testing.assert_allclose(positions[0], rest, atol=1e-7)
    np.testing.assert_allclose(positions[1], rest[0] + trans[1] + (rest - rest[0]) @ turn.T, atol=1e-7)
