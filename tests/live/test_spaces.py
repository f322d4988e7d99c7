"""Frames of reference: what they mean, and the way there and back."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from memmlp.common.errors import InputError
from memmlp.live.rotations import matrix_to_quaternion, quaternion_to_matrix
from memmlp.live.spaces import SPACES, find_space

numbers = st.floats(-10, 10)
points = st.tuples(numbers, numbers, numbers).map(np.array)
turns = st.tuples(numbers, numbers, numbers).map(lambda v: Rotation.from_rotvec(v).as_matrix())
names = st.sampled_from(sorted(SPACES))
FORWARD, UP, LEFT = np.array([0.0, 1, 0]), np.array([0.0, 0, 1]), np.array([-1.0, 0, 0])  # amass


@pytest.mark.slow
@given(names, points, turns)
def test_there_and_back(name, point, turn):
    space, pose = SPACES[name], np.stack([turn, turn.T, turn @ turn])
    for here, there, back in (
        (point, space.convert_positions_to_amass, space.convert_positions_from_amass),
        (turn, space.convert_rotations_to_amass, space.convert_rotations_from_amass),
        (pose, space.convert_pose_to_amass, space.convert_pose_from_amass),
    ):
        np.testing.assert_allclose(back(there(here)), here, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(space.convert_pose_from_amass(pose)), 1, atol=1e-9)


@given(names, points, turns, turns)
def test_a_chain_of_joints_is_the_same_in_every_space(name, offset, root, local):
    """A child at a rest offset, turned and moved in AMASS' world or in the space, is the same point."""
    space = SPACES[name]
    there_root, there_local = space.convert_pose_from_amass(np.stack([root, local]))
    found = there_root @ (offset * space.body)  # the T-pose's axes
    np.testing.assert_allclose(found, space.convert_positions_from_amass(root @ offset), atol=1e-9)
    expected = space.convert_rotations_from_amass(root @ local)
    np.testing.assert_allclose(there_root @ there_local, expected, atol=1e-9)


def test_the_axes():
    for name, forward, left_turn in (("openxr", (0, 0, -1), 1), ("unity", (0, 0, 1), -1)):
        space = SPACES[name]
        for there, here in ((forward, FORWARD), ((0, 1, 0), UP), ((-1, 0, 0), LEFT)):
            np.testing.assert_allclose(space.convert_positions_to_amass(np.array(there, float)), here)
        # the identity is a person upright who looks forward: SMPL's +Z is forward, its +X left
        upright = space.convert_rotations_to_amass(np.eye(3))
        np.testing.assert_allclose(upright, np.stack([LEFT, UP, FORWARD], 1), atol=1e-12)
        # a turn to the left is about +Y in openxr (right-handed) and about -Y in unity (left-handed)
        turn = Rotation.from_rotvec([0, left_turn * np.pi / 2, 0]).as_matrix()
        np.testing.assert_allclose(space.convert_rotations_to_amass(turn) @ [0, 0, 1], LEFT, atol=1e-12)
    with pytest.raises(InputError, match="space=maya"):
        find_space("maya")


@given(turns)
def test_quaternions_are_scipys(turn):
    quaternion = matrix_to_quaternion(turn[None])
    np.testing.assert_allclose(quaternion_to_matrix(quaternion)[0], turn, atol=1e-12)
    np.testing.assert_allclose(Rotation.from_quat(quaternion[0]).as_matrix(), turn, atol=1e-12)
