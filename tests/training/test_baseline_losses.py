"""The baselines' losses, computed independently."""

import numpy as np
import pytest
import tiny
import torch
from plain_body import posed

from memmlp.motion.body import MOTION_DIM, ROTATION, SPARSE_DIM, SPARSE_POSITION
from memmlp.motion.network_coordinates import World
from memmlp.training.losses import AGRoLLoss, AvatarPoserLoss

CLIP = tiny.clip(40)
SPARSE = CLIP[None, :, :SPARSE_DIM]
DRAWN = [torch.randn(2, 3, MOTION_DIM, generator=torch.Generator().manual_seed(i)) for i in (1, 2)]


@pytest.mark.parametrize("error", ["norm", "square"])
def test_agrols_loss_is_that_of_its_code_or_of_its_paper(error):
    """The mean over frames and joints of each joint's L2 norm, or the mean of squares, in network space."""
    (motion, truth), normalizer = DRAWN, tiny.normalizer(World())
    loss, terms = AGRoLLoss(error)(motion, truth, SPARSE[:, :3].expand(2, -1, -1), normalizer)
    scaled = (motion - truth)[..., ROTATION].numpy() / normalizer.std[SPARSE_DIM:][ROTATION].numpy()
    norms = [np.sqrt((scaled[b, t, 6 * j : 6 * j + 6] ** 2).sum()) for b, t, j in np.ndindex(2, 3, 22)]
    expected = {"norm": np.mean(norms), "square": np.mean(scaled**2)}
    assert float(loss) == pytest.approx(expected[error], rel=1e-4)
    assert set(terms) == {"rotation"}
    assert float(AGRoLLoss()(motion, truth, SPARSE[:, :3].expand(2, -1, -1), normalizer)[0]) == pytest.approx(
        expected["norm"], rel=1e-4
    )


@pytest.mark.parametrize("anchor", ["pelvis", "head"])
def test_avatar_posers_loss_compares_bodies_at_the_pelvis_or_at_the_tracker(anchor):
    """Joint by joint down the tree, in NumPy; by default as its released code has it."""
    (motion, truth), normalizer = DRAWN, tiny.normalizer(World())
    sparse = SPARSE[:, :3].expand(2, -1, -1)
    loss, terms = AvatarPoserLoss(anchor=anchor)(motion, truth, sparse, normalizer)
    difference = (motion - truth)[..., ROTATION].numpy()
    errors = []
    for b, t in np.ndindex(2, 3):
        body = posed(motion[b, t, ROTATION].numpy())
        true = truth[b, t, ROTATION.stop :].numpy().reshape(22, 3)
        head = sparse[b, t, SPARSE_POSITION][:3].numpy()
        pair = {"pelvis": (body, true - true[0]), "head": (body + head - body[15], true)}
        errors.append(np.abs(pair[anchor][0] - pair[anchor][1]))
    expected = {
        "orientation": np.abs(difference[..., :6]).mean(),
        "rotation": np.abs(difference[..., 6:]).mean(),
        "position": np.mean(errors),
    }
    assert {name: float(term) for name, term in terms.items()} == pytest.approx(expected, rel=1e-4)
    weights = {"orientation": 0.02, "rotation": 1.0, "position": 1.0}
    assert float(loss) == pytest.approx(sum(weights[name] * expected[name] for name in weights), rel=1e-4)
    assert (float(AvatarPoserLoss()(motion, truth, sparse, normalizer)[0]) == float(loss)) == (
        anchor == "pelvis"
    )


def test_avatar_posers_loss_on_positions_reaches_the_rotations():
    motion = CLIP[None, :3, SPARSE_DIM:].clone().requires_grad_()
    truth = tiny.clip(3, seed=9)[None, :, SPARSE_DIM:]
    AvatarPoserLoss(0, 0, 1)(motion, truth, SPARSE[:, :3], tiny.normalizer())[0].backward()
    assert float(motion.grad[..., ROTATION].abs().sum()) > 0
