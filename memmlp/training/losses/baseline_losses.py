"""The baselines' losses, as in their released code, and an empty loss for networks with their own losses."""

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from memmlp.common.components import component
from memmlp.common.settings import at_least, one_of, setting
from memmlp.motion.body import N_JOINTS, ROOT, ROTATION
from memmlp.motion.normalizer import Normalizer
from memmlp.training.losses.loss import CompleteLossSettings, FixedWeights, Loss, Terms, joints, read_weights
from memmlp.training.losses.terms import ERRORS, Comparison


@component("loss", "agrol", builds="AGRoLLoss")
@dataclass
class AGRoLLossSettings(CompleteLossSettings):
    """AGRoL's loss (Du et al. 2023); Mem-MLP can use it with predictor=rotation_only and hand=off."""

    # norm: mean norm of the 6D error over frames and joints, as in the released code; square: mean squared
    # error
    error: str = setting(one_of("norm", "square"), "norm")

    rotations_alone: ClassVar[bool] = True


class AGRoLLoss(Loss):
    """AGRoL's error of the 6D rotations in network space. The released code trains both networks with "norm";
    "square" is a possible reading of the paper (Du et al. 2023, L2)."""

    def __init__(self, settings: AGRoLLossSettings | None = None):
        super().__init__()
        self.error = ERRORS[(settings or AGRoLLossSettings()).error]
        self.weighting = FixedWeights({"rotation_all": 1.0})

    def terms(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        origin = normalizer.find_origin(sparse)
        error = normalizer.encode_motion(motion, origin) - normalizer.encode_motion(truth, origin)
        return {"rotation_all": self.error(error[..., ROTATION].unflatten(-1, (N_JOINTS, 6)))}


@component("loss", "avatar_poser", builds="AvatarPoserLoss")
@dataclass
class AvatarPoserLossSettings(CompleteLossSettings):
    """AvatarPoser's loss: mean absolute errors (Jiang et al. 2022)."""

    # weight of the root's orientation; 0.02 as in the released code, while the paper has 0.05
    orientation: float = setting(at_least(0), 0.02)
    rotation: float = setting(at_least(0), 1.0)  # weight of the local rotations
    position: float = setting(at_least(0), 1.0)  # weight of the joint positions from forward kinematics
    # the joint at which both bodies are aligned: pelvis, as in the released code, or head, at its tracker
    anchor: str = setting(one_of("pelvis", "head"), "pelvis")


class AvatarPoserLoss(Loss):
    """Mean absolute errors of root orientation, local rotations and joint positions (Jiang et al. 2022). The
    positions come from forward kinematics. The mean is over the 22 joints; the authors' also includes the
    fingers."""

    def __init__(self, settings: AvatarPoserLossSettings | None = None):
        super().__init__()
        settings = settings or AvatarPoserLossSettings()
        self.weighting, self.anchor = FixedWeights(read_weights(settings)), settings.anchor

    def terms(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        error = (motion - truth)[..., ROTATION].abs()
        predicted, true = normalizer.compute_positions(motion, sparse), joints(truth)
        if self.anchor == "pelvis":
            predicted, true = (one - one[..., ROOT : ROOT + 1, :] for one in (predicted, true))
        return {
            "orientation": error[..., :6].mean(),
            "rotation": error[..., 6:].mean(),
            "position": (predicted - true).abs().mean(),
        }


def sum_joint_errors(error: Tensor) -> Tensor:
    """Return the mean over all joints of the L1 norm of a joint's error (B, T, 22 n)."""
    return error.unflatten(-1, (N_JOINTS, -1)).abs().sum(-1).mean()


def sum_step_errors(error: Tensor) -> Tensor:
    """Return `sum_joint_errors` of frame-to-frame changes of the error; the last frame counts as 0."""
    frames = error.shape[1]
    return sum_joint_errors(error.diff(dim=1)) * (frames - 1) / frames


@component("loss", "rpm", builds="RPMLoss")
@dataclass
class RPMLossSettings(CompleteLossSettings):
    """RPM's loss (CVPR 2025, released code): L1 norms of joint errors and of their velocities.

    Rotations are compared in network space. Positions come from forward kinematics with the head on its
    tracker.
    """

    rotation_all: float = setting(at_least(0), 1.0)
    rotation_velocity: float = setting(at_least(0), 1.0)
    world_position: float = setting(at_least(0), 1.0)
    velocity: float = setting(at_least(0), 1.0)
    # released: positions from 6D rotations whose columns are not made orthonormal; see loss=terms
    columns: str | None = setting(one_of("released"), None)


class RPMLoss(Loss):
    """RPM's L1 norms of joint errors: rotations, positions and their velocities (CVPR 2025, released code).
    Rotations are in network space. Positions are in world metres, by forward kinematics with the head on its
    tracker."""

    def __init__(self, settings: RPMLossSettings | None = None):
        super().__init__()
        settings = settings or RPMLossSettings()
        self.columns, self.weighting = settings.columns, FixedWeights(read_weights(settings))

    def terms(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        origin = normalizer.find_origin(sparse)
        error = normalizer.encode_motion(motion, origin) - normalizer.encode_motion(truth, origin)
        rotations, pair = error[..., ROTATION], Comparison(motion, truth, sparse, normalizer, self.columns)
        positions = (pair.positions - pair.true_positions).flatten(-2)
        return {
            "rotation_all": sum_joint_errors(rotations),
            "rotation_velocity": sum_step_errors(rotations),
            "world_position": sum_joint_errors(positions),
            "velocity": sum_step_errors(positions),
        }


@component("loss", "of_network", builds="LossOfNetwork")
@dataclass
class LossOfNetworkSettings(CompleteLossSettings):
    """An empty motion loss, for networks that can train with their own losses: BoDiffusion."""


class LossOfNetwork(Loss):
    """An empty motion loss: the network trains only with its own losses (`TrainingOutputs.losses`)."""

    def __init__(self) -> None:
        super().__init__()
        self.weighting = FixedWeights({})

    def terms(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        return {}

    def forward(
        self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer
    ) -> tuple[Tensor, Terms]:
        return motion.new_zeros(()), {}
