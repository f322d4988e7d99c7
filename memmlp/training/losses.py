"""The training losses: Eqs. 1-4 and the hand term, their weighting (Eq. 5), and the baselines' losses.

The paper's terms are taken as printed: L1, summed over joints and components, mean over time and batch
(reading 10). Everything is in the world: 6D components, metres, and both per frame for velocities.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor, nn

from memmlp.motion.body import FRAME_DIM, HANDS, LOWER, N_JOINTS, POSITION, ROOT, ROTATION, SPARSE_DIM
from memmlp.motion.coordinates import World
from memmlp.motion.normalizer import Normalizer

Terms = dict[str, Tensor]


def l1(error: Tensor) -> Tensor:
    """Return the sum over components of an error's (B, T, ...) absolute values, mean over batch and time."""
    return error.abs().flatten(2).sum(-1).mean()


def joints(motion: Tensor) -> Tensor:
    """Return the joint positions (B, T, 22, 3) of motion (B, T, 198)."""
    return motion[..., POSITION].unflatten(-1, (N_JOINTS, 3))


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


class Fixed(nn.Module):
    """Fixed weights of the loss terms, by name."""

    def __init__(self, values: Mapping[str, float]):
        super().__init__()
        self.values = values

    def build(self, names: list[str]) -> None:
        """Do nothing, since there is nothing to learn."""

    def parameter_groups(self) -> list[dict]:
        """Return no parameters, since there is nothing to learn."""
        return []

    def forward(self, terms: Terms) -> Tensor:
        """Return the weighted sum of the terms."""
        return torch.stack([self.values[name] * term for name, term in terms.items()]).sum()

    def weights(self) -> Mapping[str, float]:
        """Return the weight of each term."""
        return self.values


class Manual(Fixed):
    """Fixed weights of the paper's terms (reading 8); the defaults are from its grid search (Sec. 4.4)."""

    def __init__(
        self,
        rotation: float = 1.0,
        rotation_velocity: float = 30.0,
        position: float = 0.5,
        velocity: float = 0.1,
        hand: float = 0.1,
    ):
        super().__init__(
            {
                "rotation": rotation,
                "rotation_velocity": rotation_velocity,
                "position": position,
                "velocity": velocity,
                "hand": hand,
            }
        )


class Uncertainty(nn.Module):
    """Weights by homoscedastic uncertainty (Kendall et al. 2018, reading 8): e^-s L + s with one s a term.

    Args:
        lr: learning rate of the s; with the model's own they would be too slow to settle.
    """

    def __init__(self, lr: float = 1e-2):
        super().__init__()
        self.lr = lr
        self.s = nn.ParameterDict()

    def build(self, names: list[str]) -> None:
        """Make a parameter s, starting at 0, for each term."""
        self.s = nn.ParameterDict({name: nn.Parameter(torch.zeros(())) for name in names})

    def parameter_groups(self) -> list[dict]:
        """Return the parameters s, with their own learning rate and without weight decay."""
        return [{"params": list(self.s.values()), "lr": self.lr, "weight_decay": 0.0}]

    def forward(self, terms: Terms) -> Tensor:
        """Return the weighted sum of the terms."""
        return torch.stack(
            [(-self.s[name]).exp() * term + self.s[name] for name, term in terms.items()]
        ).sum()

    def weights(self) -> Mapping[str, float]:
        """Return the present weight e^-s of each term."""
        return {name: float((-s.detach()).exp()) for name, s in self.s.items()}


Weighting = Fixed | Uncertainty


class Loss(nn.Module):
    """The interface of losses: terms by name, and their weighted sum."""

    weighting: Weighting

    def terms(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        """Return each term by name.

        Args:
            motion: predicted motion (B, T, 198), world.
            truth: true motion (B, T, 198), world.
            sparse: inputs (B, T, 54), world.
            normalizer: converts between the world and network space.
        """
        raise NotImplementedError

    def forward(
        self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer
    ) -> tuple[Tensor, Terms]:
        """Return the loss and its unweighted terms; the arguments are those of `terms`."""
        terms = self.terms(motion, truth, sparse, normalizer)
        return self.weighting(terms), terms


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


def joint_norms(error: Tensor) -> Tensor:
    """Return the L2 norm of each joint's 6D error, mean over frames and joints, for errors (..., 132)."""
    return error.unflatten(-1, (N_JOINTS, 6)).norm(dim=-1).mean()


def mean_square(error: Tensor) -> Tensor:
    """Return the mean of the squared components of errors (..., 132)."""
    return error.square().mean()


ERRORS: dict[str, Callable[[Tensor], Tensor]] = {"norm": joint_norms, "square": mean_square}


class AGRoLLoss(Loss):
    """AGRoL's error of the 6D rotations, in network space, where the diffusion model's noise lies too.

    Args:
        error: "norm" as its released code trains both networks (`joint_norms`), or "square" for the mean
            squared error that its paper can be read as (Du et al. 2023, L2).
    """

    def __init__(self, error: str = "norm"):
        super().__init__()
        self.error = ERRORS[error]
        self.weighting = Fixed({"rotation": 1.0})

    def terms(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        """Return the one term, for motion and truth (B, T, 198) and inputs (B, T, 54) in the world."""
        origin = normalizer.origin(sparse)
        error = normalizer.encode_motion(motion, origin) - normalizer.encode_motion(truth, origin)
        return {"rotation": self.error(error[..., ROTATION])}


def from_pelvis(positions: Tensor) -> Tensor:
    """Return joint positions (..., 22, 3) relative to the pelvis."""
    return positions - positions[..., ROOT : ROOT + 1, :]


def from_origin(positions: Tensor) -> Tensor:
    """Return joint positions (..., 22, 3) as they are, in the world."""
    return positions


ANCHORS: dict[str, Callable[[Tensor], Tensor]] = {"pelvis": from_pelvis, "head": from_origin}


class AvatarPoserLoss(Loss):
    """Mean absolute errors of root orientation, local rotations and joint positions (Jiang et al. 2022).

    The positions follow by forward kinematics. The mean is over the 22 joints; its authors' is over the
    fingers too, which move with the wrists.

    Args:
        orientation: weight of the root orientation's error; 0.02 in the released code, 0.05 in the paper.
        rotation: weight of the local rotations' error.
        position: weight of the positions' error.
        anchor: the point at which predicted and true body are brought together: "pelvis" as in the released
            code, which knows no translation, or "head", where the predicted head is put on its tracker.
    """

    def __init__(
        self, orientation: float = 0.02, rotation: float = 1.0, position: float = 1.0, anchor: str = "pelvis"
    ):
        super().__init__()
        weights = {"orientation": orientation, "rotation": rotation, "position": position}
        self.weighting, self.anchored = Fixed(weights), ANCHORS[anchor]

    def terms(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        """Return each term by name, for motion and truth (B, T, 198) and inputs (B, T, 54) in the world."""
        error = (motion - truth)[..., ROTATION].abs()
        position = self.anchored(normalizer.pose(motion, sparse)) - self.anchored(joints(truth))
        return {
            "orientation": error[..., :6].mean(),
            "rotation": error[..., 6:].mean(),
            "position": position.abs().mean(),
        }
