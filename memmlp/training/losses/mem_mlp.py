"""Mem-MLP's loss: Eqs. 1-4 and the hand term, combined by a weighting (Eq. 5).

The paper's terms are implemented as printed: L1, summed over joints and components, averaged over time and
batch (docs/readings.md, no. 10). All values are in world coordinates: rotations in 6D components, positions
in metres, velocities per frame."""

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
from memmlp.networks.layers import select_joints
from memmlp.training.losses.loss import Loss, Terms, Weighting, joints


def l1(error: Tensor) -> Tensor:
    """Return the L1 norm of an error (B, T, ...), summed over components, averaged over batch and time."""
    return error.abs().flatten(2).sum(-1).mean()


@component("hand", "off")
class NoHandTerm:
    """An empty hand term, for losses without one."""

    branch = "position"

    def __call__(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        return {}


@component("hand", "position", builds="PositionHandTerm")
@dataclass
class PositionHandTermSettings(Settings):
    """A hand term that compares the position branch's wrists (docs/readings.md, no. 9)."""

    @classmethod
    def problems(cls, config: Any) -> Iterator[str]:
        if not getattr(find_chosen_settings(config, "predictor"), "positions", True):
            yield f"hand=position: must be fk or off with predictor={config['predictor']['name']}"


class PositionHandTerm:
    """The hand term: L1 of both wrists' positions in the position branch (docs/readings.md, no. 9)."""

    branch = "position"

    def __call__(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        return {"hand": l1(select_joints(joints(motion), HANDS) - select_joints(joints(truth), HANDS))}


@component("hand", "fk")
class KinematicHandTerm:
    """The hand term: L1 of both wrists' positions from the rotation branch, by forward kinematics with the
    head on its tracker."""

    branch = "rotation"

    def __call__(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        """Return the hand term for motion and truth (B, T, 198) and inputs (B, T, 54), all in the world."""
        positions = normalizer.compute_positions(motion, sparse)
        return {"hand": l1(select_joints(positions, HANDS) - select_joints(joints(truth), HANDS))}


Hand = NoHandTerm | PositionHandTerm | KinematicHandTerm


class Term:
    """The interface of the slot `term`: a custom loss term with a `weight` for fixed weights (`loss=manual`).
    A network without the `branch` that the term compares does not have the term. This base class does not add
    a term."""

    branch = "position"

    def __init__(self, weight: float = 1.0):
        self.weight = weight

    def __call__(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        """Return the term by name for motion and truth (B, T, 198) and inputs (B, T, 54), world."""
        return {}


class MotionLoss(Loss):
    """Mem-MLP's loss (Eq. 5), with the terms for the predictor's branches, a hand term and an additional
    custom term. Raises InputError if two terms have the same name, or a term does not have a weight."""

    def __init__(self, weighting: Weighting, hand: Hand, branches: frozenset[str], term: Term | None = None):
        super().__init__()
        self.weighting, self.hand, self.branches = weighting, hand, branches
        self.term = term or Term()
        # The weighting gets the terms' names from two frames of zeros.
        probe = torch.zeros(1, 2, FRAME_DIM)
        normalizer = Normalizer.from_coordinates(World(), torch.zeros(N_JOINTS, 3))
        motion = probe[..., SPARSE_DIM:]
        probed = motion, motion, probe[..., :SPARSE_DIM], normalizer
        custom_weights = dict.fromkeys(self._compute_custom_term(*probed), self.term.weight)
        if twice := custom_weights.keys() & self._compute_paper_terms(*probed).keys():
            raise InputError(f"term: '{min(twice)}' must have another name, since this name is in use")
        weighting.build(list(self.terms(*probed)), custom_weights)

    def terms(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        paper = self._compute_paper_terms(motion, truth, sparse, normalizer)
        return paper | self._compute_custom_term(motion, truth, sparse, normalizer)

    def _compute_custom_term(
        self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer
    ) -> Terms:
        given = self.term.branch in self.branches
        return self.term(motion, truth, sparse, normalizer) if given else {}

    def _compute_paper_terms(
        self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer
    ) -> Terms:
        terms: Terms = {}
        rotation, position = (motion - truth).split([ROTATION.stop, 3 * N_JOINTS], -1)
        if "rotation" in self.branches:  # Eqs. 1 and 2
            terms |= {"rotation_all": l1(rotation), "rotation_velocity": l1(rotation.diff(dim=1))}
        if "position" in self.branches:  # Eqs. 3 and 4, whose velocities are those of the lower body
            lower = select_joints(position.unflatten(-1, (N_JOINTS, 3)), LOWER)
            terms |= {"position_branch": l1(position), "velocity_lower_body": l1(lower.diff(dim=1))}
        if self.hand.branch in self.branches:
            terms |= self.hand(motion, truth, sparse, normalizer)
        return terms
