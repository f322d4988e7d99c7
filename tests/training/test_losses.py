"""The loss terms against the paper's equations written out as loops, and their weighting."""

import math

import pytest
import tiny
import torch

from memmlp.motion.body import LOWER, SPARSE_DIM
from memmlp.training.losses import (
    KinematicHandTerm,
    ManualWeights,
    MotionLoss,
    NoHandTerm,
    PositionHandTerm,
    UncertaintyWeights,
)

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
    truth, batch, time = TRUTH[..., SPARSE_DIM:], 2, 9
    names = ["rotation_all", "rotation_velocity", "position_branch", "velocity_lower_body", "hand"]
    expected = dict.fromkeys(names, 0.0)
    for b in range(batch):
        for t in range(time):
            error = MOTION[b, t] - truth[b, t]
            for joint in range(22):
                position = error[132 + 3 * joint : 135 + 3 * joint].abs().sum().item()
                expected["rotation_all"] += error[6 * joint : 6 * joint + 6].abs().sum().item() / time / batch
                expected["position_branch"] += position / time / batch
                expected["hand"] += position / time / batch if joint in (20, 21) else 0
            if t + 1 < time:
                step = (truth[b, t + 1] - truth[b, t]) - (MOTION[b, t + 1] - MOTION[b, t])
                expected["rotation_velocity"] += step[:132].abs().sum().item() / (time - 1) / batch
                for joint in LOWER:
                    part = step[132 + 3 * joint : 135 + 3 * joint]
                    expected["velocity_lower_body"] += part.abs().sum().item() / (time - 1) / batch
    assert {name: float(term) for name, term in terms().items()} == pytest.approx(expected, rel=1e-4)


def test_hand_by_forward_kinematics_is_of_the_rotation_branch():
    moved = MOTION.clone()
    moved[..., 132:] += 1
    loss = MotionLoss(ManualWeights(), KinematicHandTerm(), BOTH)
    args = (TRUTH[..., SPARSE_DIM:], SPARSE, NORMALIZER)
    assert torch.equal(loss.terms(MOTION, *args)["hand"], loss.terms(moved, *args)["hand"])
    assert float(loss.terms(TRUTH[..., SPARSE_DIM:], *args)["hand"]) == pytest.approx(0, abs=1e-4)


def test_hand_off_and_rotation_only_leave_terms_out():
    assert "hand" not in terms(NoHandTerm())
    rotation = frozenset({"rotation"})
    assert set(terms(PositionHandTerm(), rotation)) == {"rotation_all", "rotation_velocity"}
    assert set(terms(KinematicHandTerm(), rotation)) == {"rotation_all", "rotation_velocity", "hand"}


def train(weighting: UncertaintyWeights, optimiser: type, steps: int, **losses: float) -> None:
    weights = optimiser(weighting.parameter_groups())
    for _ in range(steps):
        weights.zero_grad()
        weighting({name: torch.tensor(loss) for name, loss in losses.items()}).backward()
        weights.step()


def test_uncertainty_settles_where_the_weight_is_one_over_the_loss():
    """The minimum of e^-s L + s is s = ln L."""
    weighting = UncertaintyWeights(lr=0.05)
    weighting.build(["rotation_all", "position_branch"])
    assert weighting.parameter_groups()[0]["lr"] == 0.05
    train(weighting, torch.optim.Adam, 400, rotation_all=4.0, position_branch=0.1)
    assert weighting.weights() == pytest.approx({"rotation_all": 1 / 4, "position_branch": 10}, rel=1e-2)
    assert weighting.s["rotation_all"].item() == pytest.approx(math.log(4), rel=1e-2)


def test_a_custom_term_has_its_own_weight_also_under_the_name_of_a_term_that_is_not_there():
    weighting = ManualWeights()
    weighting.build(["rotation_all", "hand"], {"hand": 7.0})
    terms = {"rotation_all": torch.tensor(1.0), "hand": torch.tensor(1.0)}
    assert float(weighting(terms)) == pytest.approx(1 + 7)
