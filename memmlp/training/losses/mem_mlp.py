"""Mem-MLP's loss: Eqs. 1-4 and the hand term, put together with a weighting (Eq. 5).

The paper's terms are taken as printed: L1, summed over joints and components, mean over time and batch
(reading 10). Everything is in the world: rotations in 6D components, positions in metres, and velocities in
either per frame.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from memmlp.common.components import component, find_chosen_settings
from memmlp.common.errors import InputError
from memmlp.common.settings import Settings
from memmlp.motion.body import FRAME_DIM, HANDS, LOWER, N_JOINTS, ROTATION, SPARSE_DIM
from memmlp.motion.network_coordinates import World
from memmlp.motion.normalizer import Normalizer
from memmlp.training.losses.loss import Loss, Terms, Weighting, joints


def l1(error: Tensor) -> Tensor:
    """Return the sum of an error's (B, T, ...) absolute values over components, mean over batch and time."""
    return error.abs().flatten(2).sum(-1).mean()


@component("hand", "off")
class NoHand:
    """The choice to have no hand term."""

    branch = "position"

    def __call__(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        """Return no term."""
        return {}


@component("hand", "position", builds="HandPosition")
@dataclass
class HandPositionSettings(Settings):
    """The hand term compares the wrists' positions of the position branch (reading 9)."""

    @classmethod
    def problems(cls, config: Any) -> Iterator[str]:
        """Yield whether the predictor has no positions; see Settings."""
        if not getattr(find_chosen_settings(config, "predictor"), "positions", True):
            yield f"hand=position: must be fk or off with predictor={config['predictor']['name']}"


class HandPosition:
    """The hand term as L1 on both wrists' positions in the position branch (reading 9)."""

    branch = "position"

    def __call__(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        """Return the hand term, from motion and truth (B, T, 198)."""
        hands = list(HANDS)
        return {"hand": l1((joints(motion) - joints(truth))[:, :, hands])}


@component("hand", "fk")
class HandFK:
    """The hand term as L1 on both wrists' positions by forward kinematics of the rotation branch.

    The head of the predicted body is put on its tracker.
    """

    branch = "rotation"

    def __call__(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        """Return the hand term, from motion and truth (B, T, 198) and inputs (B, T, 54), all in the world."""
        hands = list(HANDS)
        return {"hand": l1(normalizer.pose(motion, sparse)[:, :, hands] - joints(truth)[:, :, hands])}


Hand = NoHand | HandPosition | HandFK


class Term:
    """A custom term of the loss; the interface of the slot `term`. This base class adds none.

    Args:
        weight: the term's weight with fixed weights (`loss=manual`); uncertainty weighting learns one.

    Attributes:
        branch: the branch that the term compares; a network without this branch does not have the term.
    """

    branch = "position"

    def __init__(self, weight: float = 1.0):
        self.weight = weight

    def __call__(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        """Return the term by its name, for motion and truth (B, T, 198) and inputs (B, T, 54), world."""
        return {}


class MotionLoss(Loss):
    """Mem-MLP's loss (Eq. 5), with the terms of those branches that the predictor has.

    Args:
        weighting: Manual or Uncertainty.
        hand: the hand term.
        branches: the predictor's branches.
        term: one more, custom term.

    Raises:
        InputError: if two terms have the same name, or a term has no weight.
    """

    def __init__(self, weighting: Weighting, hand: Hand, branches: frozenset[str], term: Term | None = None):
        super().__init__()
        self.weighting, self.hand, self.branches = weighting, hand, branches
        self.term = term or Term()
        # The weighting gets the terms' names from two frames of zeros.
        probe = torch.zeros(1, 2, FRAME_DIM)
        normalizer = Normalizer.raw(World(), torch.zeros(N_JOINTS, 3))
        motion = probe[..., SPARSE_DIM:]
        probed = motion, motion, probe[..., :SPARSE_DIM], normalizer
        own = dict.fromkeys(self._own(*probed), self.term.weight)
        if twice := own.keys() & self._paper(*probed).keys():
            raise InputError(f"term: '{min(twice)}' must have another name, since the loss has such a term")
        weighting.build(list(self.terms(*probed)), own)

    def terms(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        paper = self._paper(motion, truth, sparse, normalizer)
        return paper | self._own(motion, truth, sparse, normalizer)

    def _own(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        """Return the custom term, if the network has the branch that it compares."""
        given = self.term.branch in self.branches
        return self.term(motion, truth, sparse, normalizer) if given else {}

    def _paper(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        """Return the paper's terms and the hand term."""
        terms: Terms = {}
        if "rotation" in self.branches:
            error = (motion - truth)[..., ROTATION]
            terms |= {"rotation_all": l1(error), "rotation_velocity": l1(error.diff(dim=1))}  # Eqs. 1 and 2
        if "position" in self.branches:
            error = joints(motion) - joints(truth)
            steps = error[:, :, list(LOWER)].diff(dim=1)  # of the lower body only
            terms |= {"position_branch": l1(error), "velocity_lower_body": l1(steps)}  # Eqs. 3 and 4
        if self.hand.branch in self.branches:
            terms |= self.hand(motion, truth, sparse, normalizer)
        return terms
