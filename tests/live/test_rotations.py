"""The NumPy functions compute what the torch functions do."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation, Slerp

from memmlp.live.rotations import BodyTree, rotate_by_fraction, sixd_to_matrix, slerp
from memmlp.motion import geometry
from memmlp.motion.body import HEAD, make_builtin_rest_joints

LOCAL = Rotation.random(22, rng=0).as_matrix()


def test_gram_schmidt_and_forward_kinematics_are_those_of_torch():
    sixd, rest = np.random.default_rng(0).normal(size=(22, 6)), make_builtin_rest_joints()
    expected = geometry.sixd_to_matrix(torch.tensor(sixd)).numpy()
    np.testing.assert_allclose(sixd_to_matrix(sixd), expected, atol=1e-12)
    root = torch.zeros(3).double()
    _, expected = geometry.forward_kinematics(torch.tensor(LOCAL), root, torch.tensor(rest))
    found = BodyTree(rest).compute_positions(LOCAL)
    np.testing.assert_allclose(found, (expected - expected[HEAD]).numpy(), atol=2e-6)


def test_slerp_is_scipys():
    a, b = LOCAL[:3], LOCAL[3:6]
    for weight in (0.0, 0.25, 1.0):
        for k, found in enumerate(slerp(a, b, weight)):
            expected = Slerp([0, 1], Rotation.from_matrix(np.stack([a[k], b[k]])))(weight).as_matrix()
            np.testing.assert_allclose(found, expected, atol=1e-12)


def test_a_share_of_no_turn_is_no_turn():
    tiny = Rotation.from_rotvec([[0, 0, 0], [1e-12, 0, 0], [2e-3, 0, 0]]).as_matrix()
    found = Rotation.from_matrix(rotate_by_fraction(tiny, np.full(3, 0.5))).as_rotvec()
    np.testing.assert_allclose(found, [[0, 0, 0], [5e-13, 0, 0], [1e-3, 0, 0]], atol=1e-14)
