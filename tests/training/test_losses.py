"""The loss terms against the paper's equations written out as loops, and their weighting."""

import math

import numpy as np
import pytest
import tiny
import torch

from memmlp.motion.body import LOWER, SPARSE_DIM
from memmlp.training import losses
from memmlp.training.losses import KinematicHandTerm, ManualWeights, MotionLoss, PositionHandTerm

BOTH = frozenset({"rotation", "position"})
DRAW = torch.Generator().manual_seed(0)
TRUTH = torch.stack([tiny.clip(9, seed) for seed in range(2)])
MOTION = TRUTH[..., SPARSE_DIM:] + 0.1 * torch.randn(2, 9, 198, generator=DRAW)
SPARSE = TRUTH[..., :SPARSE_DIM]
NORMALIZER = tiny.normalizer()


def terms(hand=None, branches=BOTH):
    loss = MotionLoss(ManualWeights(), hand or PositionHandTerm(), branches)
    return loss.terms(MOTION, TRUTH[..., SPARSE_DIM:], SPARSE, NORMALIZER)


def test_terms_are_the_papers_equations():
    """Eqs. 1-4, summed over joints and components, mean over time and batch."""
    error = (MOTION - TRUTH[..., SPARSE_DIM:]).double().numpy()
    places, steps = error[..., 132:].reshape(2, 9, 22, 3), np.diff(error, axis=1)
    sums = {
        "rotation_all": error[..., :132], "rotation_velocity": steps[..., :132], "position_branch": places,
        "velocity_lower_body": np.diff(places, axis=1)[:, :, LOWER], "hand": places[:, :, [20, 21]],
    }  # fmt: skip
    expected = {name: np.abs(part).sum() / part.shape[0] / part.shape[1] for name, part in sums.items()}
    assert {name: float(term) for name, term in terms().items()} == pytest.approx(expected, rel=1e-4)


def test_hand_terms_are_of_the_rotation_branch_or_left_out():
    moved = MOTION.clone()
    moved[..., 132:] += 1
    loss = MotionLoss(ManualWeights(), KinematicHandTerm(), BOTH)
    args = (TRUTH[..., SPARSE_DIM:], SPARSE, NORMALIZER)
    assert torch.equal(loss.terms(MOTION, *args)["hand"], loss.terms(moved, *args)["hand"])
    assert float(loss.terms(TRUTH[..., SPARSE_DIM:], *args)["hand"]) == pytest.approx(0, abs=1e-4)
    assert "hand" not in terms(losses.NoHandTerm())
    rotation = frozenset({"rotation"})
    assert set(terms(PositionHandTerm(), rotation)) == {"rotation_all", "rotation_velocity"}
    assert set(terms(KinematicHandTerm(), rotation)) == {"rotation_all", "rotation_velocity", "hand"}


def test_weights_settle_at_one_over_the_loss_and_custom_terms_have_their_own():
    """The minimum of e^-s L + s is s = ln L."""
    weighting = losses.UncertaintyWeights(lr=0.05)
    weighting.build(["rotation_all", "position_branch"])
    assert weighting.parameter_groups()[0]["lr"] == 0.05
    optimiser = torch.optim.Adam(weighting.parameter_groups())
    for _ in range(400):
        optimiser.zero_grad()
        weighting({"rotation_all": torch.tensor(4.0), "position_branch": torch.tensor(0.1)}).backward()
        optimiser.step()
    assert weighting.weights() == pytest.approx({"rotation_all": 1 / 4, "position_branch": 10}, rel=1e-2)
    assert weighting.s["rotation_all"].item() == pytest.approx(math.log(4), rel=1e-2)
    weighting = ManualWeights()
    weighting.build(["rotation_all", "hand"], {"hand": 7.0})
    terms = {"rotation_all": torch.tensor(1.0), "hand": torch.tensor(1.0)}
    assert float(weighting(terms)) == pytest.approx(1 + 7)
