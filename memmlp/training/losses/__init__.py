"""The training losses: Mem-MLP's, the baselines', and a library of terms that any network's loss can take."""

from memmlp.training.losses.baseline_losses import (
    AGRoLLoss,
    AvatarPoserLoss,
    LossOfNetwork,
    RPMLoss,
)
from memmlp.training.losses.loss import (
    Fixed,
    LearnedWeights,
    Loss,
    Manual,
    Terms,
    Uncertainty,
    Weighting,
    joints,
)
from memmlp.training.losses.mem_mlp import HandFK, HandPosition, MotionLoss, NoHand, Term, l1
from memmlp.training.losses.terms import TermsLoss

__all__ = [
    "AGRoLLoss",
    "AvatarPoserLoss",
    "Fixed",
    "HandFK",
    "HandPosition",
    "LearnedWeights",
    "Loss",
    "LossOfNetwork",
    "Manual",
    "MotionLoss",
    "NoHand",
    "RPMLoss",
    "Term",
    "Terms",
    "TermsLoss",
    "Uncertainty",
    "Weighting",
    "joints",
    "l1",
]
