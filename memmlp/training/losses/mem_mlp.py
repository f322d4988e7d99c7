"""Mem-MLP's loss: Eqs. 1-4 and the hand term, put together with a weighting (Eq. 5).

The paper's terms are taken as printed: L1, summed over joints and components, mean over time and batch
(reading 10). Everything is in the world: 6D components, metres, and both per frame for velocities.
"""

from __future__ import annotations

import torch
from torch import Tensor

from memmlp.motion.body import FRAME_DIM, HANDS, LOWER, N_JOINTS, ROTATION, SPARSE_DIM
from memmlp.motion.coordinates import World
from memmlp.motion.normalizer import Normalizer
from memmlp.training.losses.loss import Loss, Terms, Weighting, joints


def l1(error: Tensor) -> Tensor:
    """Return the sum over components of an error's (B, T, ...) absolute values, mean over batch and time."""
    return error.abs().flatten(2).sum(-1).mean()


class NoHand:
    """The choice of no hand term."""

    branch = "position"

    def __call__(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        """Return no term."""
        return {}


class HandPosition:
    """The hand term as L1 on both wrists' positions in the position branch (reading 9)."""

    branch = "position"

    def __call__(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        """Return the term for motion and truth (B, T, 198)."""
        hands = list(HANDS)
        return {"hand": l1((joints(motion) - joints(truth))[:, :, hands])}


class HandFK:
    """The hand term as L1 on both wrists' positions by forward kinematics of the rotation branch.

    The head of the predicted body stands where its tracker says.
    """

    branch = "rotation"

    def __call__(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        """Return the term for motion and truth (B, T, 198) and inputs (B, T, 54), all in the world."""
        hands = list(HANDS)
        return {"hand": l1(normalizer.pose(motion, sparse)[:, :, hands] - joints(truth)[:, :, hands])}


Hand = NoHand | HandPosition | HandFK


def rotation_terms(motion: Tensor, truth: Tensor) -> Terms:
    """Return Eqs. 1 and 2 for motion and truth (B, T, 198)."""
    error = (motion - truth)[..., ROTATION]
    return {"rotation": l1(error), "rotation_velocity": l1(error.diff(dim=1))}


def position_terms(motion: Tensor, truth: Tensor) -> Terms:
    """Return Eqs. 3 and 4 (the latter on the lower body alone) for motion and truth (B, T, 198)."""
    error = joints(motion) - joints(truth)
    return {"position": l1(error), "velocity": l1(error[:, :, list(LOWER)].diff(dim=1))}


class MotionLoss(Loss):
    """Mem-MLP's loss (Eq. 5), of the terms of the branches that the predictor has.

    Args:
        weighting: Manual or Uncertainty.
        hand: the hand term.
        branches: the predictor's branches.
    """

    def __init__(self, weighting: Weighting, hand: Hand, branches: frozenset[str]):
        super().__init__()
        self.weighting, self.hand, self.branches = weighting, hand, branches
        # The terms of two frames of zeros tell the weighting which names there are.
        probe = torch.zeros(1, 2, FRAME_DIM)
        normalizer = Normalizer.raw(World(), torch.zeros(N_JOINTS, 3))
        motion = probe[..., SPARSE_DIM:]
        weighting.build(list(self.terms(motion, motion, probe[..., :SPARSE_DIM], normalizer)))

    def terms(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        """Return each term by name, for motion and truth (B, T, 198) and inputs (B, T, 54) in the world."""
        terms: Terms = {}
        if "rotation" in self.branches:
            terms |= rotation_terms(motion, truth)
        if "position" in self.branches:
            terms |= position_terms(motion, truth)
        if self.hand.branch in self.branches:
            terms |= self.hand(motion, truth, sparse, normalizer)
        return terms
