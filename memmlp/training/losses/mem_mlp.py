"""Mem-MLP's loss: Eqs. 1-4 and the hand term, put together with a weighting (Eq. 5).

The paper's terms are taken as printed: L1, summed over joints and components, mean over time and batch
(reading 10). Everything is in the world: 6D components, metres, and both per frame for velocities.
"""

from __future__ import annotations

import torch
from torch import Tensor

from memmlp.common.errors import InputError
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


class Term:
    """One more term of the loss, of one's own; the interface of the slot `term`. Here it is none.

    Args:
        weight: its weight with fixed weights (`loss=manual`); uncertainty weighting learns one.

    Attributes:
        branch: the branch that it looks at; a network without it has no such term.
    """

    branch = "position"

    def __init__(self, weight: float = 1.0):
        self.weight = weight

    def __call__(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        """Return the term by its name, for motion and truth (B, T, 198), inputs (B, T, 54) in the world."""
        return {}


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
        term: one more term, of one's own.

    Raises:
        InputError: where two terms have one name, or one has no weight.
    """

    def __init__(self, weighting: Weighting, hand: Hand, branches: frozenset[str], term: Term | None = None):
        super().__init__()
        self.weighting, self.hand, self.branches = weighting, hand, branches
        self.term = term or Term()
        # The terms of two frames of zeros tell the weighting which names there are.
        probe = torch.zeros(1, 2, FRAME_DIM)
        normalizer = Normalizer.raw(World(), torch.zeros(N_JOINTS, 3))
        motion = probe[..., SPARSE_DIM:]
        probed = motion, motion, probe[..., :SPARSE_DIM], normalizer
        own = dict.fromkeys(self._own(*probed), self.term.weight)
        if twice := own.keys() & self._paper(*probed).keys():
            raise InputError(f"term: '{min(twice)}' is a term of the loss already; allowed is another name")
        weighting.build(list(self.terms(*probed)), own)

    def terms(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        """Return each term by name, for motion and truth (B, T, 198) and inputs (B, T, 54) in the world."""
        paper = self._paper(motion, truth, sparse, normalizer)
        return paper | self._own(motion, truth, sparse, normalizer)

    def _own(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        """Return the term of one's own, if the network has its branch."""
        given = self.term.branch in self.branches
        return self.term(motion, truth, sparse, normalizer) if given else {}

    def _paper(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        """Return the paper's terms and the hand's."""
        terms: Terms = {}
        if "rotation" in self.branches:
            terms |= rotation_terms(motion, truth)
        if "position" in self.branches:
            terms |= position_terms(motion, truth)
        if self.hand.branch in self.branches:
            terms |= self.hand(motion, truth, sparse, normalizer)
        return terms
