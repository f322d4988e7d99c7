"""Rotations against SciPy, gradients at awkward angles, forward kinematics against a plain recursion."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from memmlp.motion import geometry
from memmlp.motion.body import JOINTS, PARENTS, make_builtin_rest_joints
from memmlp.motion.clip import Clip
from memmlp.motion.geometry import compute_clip_kinematics

ANGLES = (0.0, 1e-9, 1e-7, 1e-3, 1.0, 3.0, math.pi - 1e-4, math.pi - 1e-7, 10.0)


def vectors(angle: float, count: int = 50) -> torch.Tensor:
    axis = np.random.default_rng(0).normal(size=(count, 3))
    return torch.tensor(angle * axis / np.linalg.norm(axis, axis=-1, keepdims=True))


def test_axis_angle_is_scipys():
    for angle in ANGLES:
        matrix = Rotation.from_rotvec(vectors(angle).numpy()).as_matrix()
        np.testing.assert_allclose(geometry.axis_angle_to_matrix(vectors(angle)).numpy(), matrix, atol=1e-12)
        expected = Rotation.from_matrix(matrix).as_rotvec()
        got = geometry.matrix_to_axis_angle(torch.tensor(matrix)).numpy()
        np.testing.assert_allclose(got, expected, atol=1e-7)
        assert (np.linalg.norm(got, axis=-1) <= math.pi + 1e-12).all()


@pytest.mark.parametrize("angle", [1e-7, math.pi - 1e-3])
def test_gradients(angle):
    assert torch.autograd.gradcheck(
        geometry.axis_angle_to_matrix, vectors(angle, 3).requires_grad_(), atol=1e-5
    )


@pytest.mark.parametrize("count", [20, 3])
def test_sixd_is_two_columns_and_gram_schmidt_of_anything(count):
    """torch.cross without `dim` goes wrong on 3 x 3."""
    matrix = torch.tensor(Rotation.random(count, rng=0).as_matrix())
    sixd = geometry.matrix_to_sixd(matrix)
    assert torch.equal(sixd, torch.cat([matrix[:, :, 0], matrix[:, :, 1]], -1))
    stretched = torch.cat([1.7 * sixd[:, :3], 0.4 * sixd[:, 3:] + 0.3 * sixd[:, :3]], -1)
    for columns in (sixd, stretched):
        torch.testing.assert_close(geometry.sixd_to_matrix(columns), matrix)


def test_almost_rotations_are_read_as_human_body_prior_does():
    """Rotations stay. Otherwise the diagonal's signs choose the quaternion's form, not its largest pivot."""
    rotations = torch.tensor(Rotation.random(200, random_state=0).as_matrix())
    torch.testing.assert_close(geometry.convert_almost_rotations(rotations), rotations)
    columns = geometry.complete_columns(geometry.matrix_to_sixd(rotations))
    torch.testing.assert_close(columns, rotations)
    stretched = torch.tensor([[1, 0, 0], [0, 0.5, -0.9], [0, 0.9, -0.1]], dtype=torch.float64)
    expected = Rotation.from_quat([1 + 1 - 0.5 + 0.1, 0, 0, 0.9 + 0.9]).as_matrix()
    torch.testing.assert_close(geometry.convert_almost_rotations(stretched), torch.tensor(expected))


def test_geodesic_angle():
    a = torch.tensor(Rotation.random(50, rng=2).as_matrix())
    for angle in (0.0, 1e-6, math.pi):
        b = a @ geometry.axis_angle_to_matrix(vectors(angle))
        np.testing.assert_allclose(geometry.compute_geodesic_angle(a, b).numpy(), angle, atol=1e-7)


def test_forward_kinematics_is_a_recursion():
    rng = np.random.default_rng(3)
    local = Rotation.random(22, rng=3).as_matrix()
    root, rest = rng.normal(size=3), rng.normal(size=(22, 3))

    def place(joint: int) -> tuple[np.ndarray, np.ndarray]:
        if joint == 0:
            return local[0], root
        rotation, position = place(PARENTS[joint])
        return rotation @ local[joint], position + rotation @ (rest[joint] - rest[PARENTS[joint]])

    args = (torch.tensor(x)[None] for x in (local, root))
    rotations, positions = geometry.forward_kinematics(*args, torch.tensor(rest))
    for joint in range(22):
        expected = place(joint)
        np.testing.assert_allclose(rotations[0, joint], expected[0], atol=1e-12)
        np.testing.assert_allclose(positions[0, joint], expected[1], atol=1e-12)


def test_the_built_in_body_is_a_person():
    rest = dict(zip(JOINTS, make_builtin_rest_joints(), strict=True))
    heights = [rest[name][1] for name in ("head", "neck", "pelvis", "left_knee", "left_ankle")]
    assert heights == sorted(heights, reverse=True)
    for name in JOINTS:
        if name.startswith("left_"):
            assert rest[name][0] > 0
            np.testing.assert_allclose(rest[name] * [-1, 1, 1], rest["right_" + name[5:]])
    assert 1.5 < rest["head"][1] - rest["left_foot"][1] < 1.7


def test_a_body_that_is_turned_about_its_pelvis():
    """By a right angle about X in its second frame; the pelvis alone keeps its offset unturned."""
    rest, poses = make_builtin_rest_joints() + np.array([0.1, 0.2, 0.3]), np.zeros((2, 22, 3))
    poses[1, 0, 0] = np.pi / 2
    trans = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]])
    rotations, positions = compute_clip_kinematics(Clip("turned", poses, trans, 60.0), rest)
    turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    for frame, matrix in enumerate((np.eye(3), turn)):
        np.testing.assert_allclose(rotations[frame], np.tile(matrix, (22, 1, 1)), atol=1e-7)
        expected = rest[0] + trans[frame] + (rest - rest[0]) @ matrix.T
        np.testing.assert_allclose(positions[frame], expected, atol=1e-7)
