"""Losses of baselines as in their released codes, and the empty one of networks that bring their own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from memmlp.common.components import component
from memmlp.common.settings import at_least, one_of, setting
from memmlp.motion.body import N_JOINTS, ROOT, ROTATION
from memmlp.motion.normalizer import Normalizer
from memmlp.training.losses.loss import CompleteLossSettings, Fixed, Loss, Terms, joints, read_weights
from memmlp.training.losses.terms import Comparison

ERRORS: dict[str, Callable[[Tensor], Tensor]] = {
    "norm": lambda error: error.unflatten(-1, (N_JOINTS, 6)).norm(dim=-1).mean(),
    "square": lambda error: error.square().mean(),
}
"""How AGRoL's 6D errors (..., 132) become a number."""

ANCHORS: dict[str, Callable[[Tensor], Tensor]] = {
    "pelvis": lambda positions: positions - positions[..., ROOT : ROOT + 1, :],
    "head": lambda positions: positions,
}
"""How joint positions (..., 22, 3), whose head is on its tracker, are anchored before they are compared."""


@component("loss", "agrol", builds="AGRoLLoss")
@dataclass
class AGRoLLossSettings(CompleteLossSettings):
    """AGRoL's loss (Du et al. 2023); Mem-MLP can have it with predictor=rotation_only and hand=off."""

    # norm: the mean over frames and joints of the 6D error's norm, as in the released code; square: the mean
    # squared error
    error: str = setting(one_of("norm", "square"), "norm")

    rotations_alone: ClassVar[bool] = True


class AGRoLLoss(Loss):
    """AGRoL's error of the 6D rotations, in network space, as is the diffusion model's noise.

    The error "norm" is that with which its released code trains both networks; "square" is a possible reading
    of its paper (Du et al. 2023, L2).
    """

    def __init__(self, settings: AGRoLLossSettings | None = None):
        super().__init__()
        self.error = ERRORS[(settings or AGRoLLossSettings()).error]
        self.weighting = Fixed({"rotation_all": 1.0})

    def terms(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        """Return the one term, from motion and truth (B, T, 198) and inputs (B, T, 54) in the world."""
        origin = normalizer.origin(sparse)
        error = normalizer.encode_motion(motion, origin) - normalizer.encode_motion(truth, origin)
        return {"rotation_all": self.error(error[..., ROTATION])}


@component("loss", "avatar_poser", builds="AvatarPoserLoss")
@dataclass
class AvatarPoserLossSettings(CompleteLossSettings):
    """AvatarPoser's loss, of mean absolute errors (Jiang et al. 2022)."""

    # weight of the root's orientation: the released code's; its paper has 0.05
    orientation: float = setting(at_least(0), 0.02)
    rotation: float = setting(at_least(0), 1.0)  # weight of the local rotations
    position: float = setting(at_least(0), 1.0)  # weight of the positions by forward kinematics
    # where both bodies coincide: pelvis, as in the released code, or head, with the predicted head on its
    # tracker
    anchor: str = setting(one_of("pelvis", "head"), "pelvis")


class AvatarPoserLoss(Loss):
    """Mean absolute errors of root orientation, local rotations and joint positions (Jiang et al. 2022).

    The positions follow by forward kinematics. The mean is over the 22 joints; the authors' mean includes the
    fingers, which move with the wrists.
    """

    def __init__(self, settings: AvatarPoserLossSettings | None = None):
        super().__init__()
        settings = settings or AvatarPoserLossSettings()
        self.weighting, self.anchored = Fixed(read_weights(settings)), ANCHORS[settings.anchor]

    def terms(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        error = (motion - truth)[..., ROTATION].abs()
        position = self.anchored(normalizer.pose(motion, sparse)) - self.anchored(joints(truth))
        return {
            "orientation": error[..., :6].mean(),
            "rotation": error[..., 6:].mean(),
            "position": position.abs().mean(),
        }


def joint_sums(error: Tensor) -> Tensor:
    """Return the L1 norm of each joint's error (B, T, 22 n), averaged over frames and joints."""
    return error.unflatten(-1, (N_JOINTS, -1)).abs().sum(-1).mean()


def joint_sums_of_steps(error: Tensor) -> Tensor:
    """Return the same of an error's steps between frames; the last frame counts as right."""
    frames = error.shape[1]
    return joint_sums(error.diff(dim=1)) * (frames - 1) / frames


@component("loss", "rpm", builds="RPMLoss")
@dataclass
class RPMLossSettings(CompleteLossSettings):
    """RPM's loss (CVPR 2025, released code): L1 norms of the joints' errors, and of their steps.

    Rotations are as the network sees them, positions by forward kinematics with the head on its tracker.
    """

    rotation_all: float = setting(at_least(0), 1.0)
    rotation_velocity: float = setting(at_least(0), 1.0)
    world_position: float = setting(at_least(0), 1.0)
    velocity: float = setting(at_least(0), 1.0)


class RPMLoss(Loss):
    """L1 norms of joints' errors in rotations and positions, and in how both move (CVPR 2025, released code).

    Rotations are compared in network space, so as z-scores where the network has them; positions by forward
    kinematics with the head on its tracker, metres in the world.
    """

    def __init__(self, settings: RPMLossSettings | None = None):
        super().__init__()
        self.weighting = Fixed(read_weights(settings or RPMLossSettings()))

    def terms(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        origin = normalizer.origin(sparse)
        error = normalizer.encode_motion(motion, origin) - normalizer.encode_motion(truth, origin)
        rotations, pair = error[..., ROTATION], Comparison(motion, truth, sparse, normalizer)
        positions = (pair.positions - pair.true_positions).flatten(-2)
        return {
            "rotation_all": joint_sums(rotations),
            "rotation_velocity": joint_sums_of_steps(rotations),
            "world_position": joint_sums(positions),
            "velocity": joint_sums_of_steps(positions),
        }


@component("loss", "of_network", builds="LossOfNetwork")
@dataclass
class LossOfNetworkSettings(CompleteLossSettings):
    """Only the network's own loss, for networks that can train with it: BoDiffusion."""


class LossOfNetwork(Loss):
    """No loss of the motion: a network trains with its own losses alone (`TrainingOutputs.losses`)."""

    def __init__(self) -> None:
        super().__init__()
        self.weighting = Fixed({})

    def terms(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        """Return no terms."""
        return {}

    def forward(
        self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer
    ) -> tuple[Tensor, Terms]:
        """Return 0 and no terms."""
        return motion.new_zeros(()), {}
