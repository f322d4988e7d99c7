"""Training losses: Mem-MLP's loss, the baselines' losses, and a library of loss terms for any network."""

from memmlp.training.losses.baseline_losses import AGRoLLoss as AGRoLLoss
from memmlp.training.losses.baseline_losses import AvatarPoserLoss as AvatarPoserLoss
from memmlp.training.losses.baseline_losses import LossOfNetwork as LossOfNetwork
from memmlp.training.losses.baseline_losses import RPMLoss as RPMLoss
from memmlp.training.losses.loss import FixedWeights as FixedWeights
from memmlp.training.losses.loss import Loss as Loss
from memmlp.training.losses.loss import ManualWeights as ManualWeights
from memmlp.training.losses.loss import Terms as Terms
from memmlp.training.losses.loss import UncertaintyWeights as UncertaintyWeights
from memmlp.training.losses.loss import Weighting as Weighting
from memmlp.training.losses.loss import joints as joints
from memmlp.training.losses.mem_mlp import KinematicHandTerm as KinematicHandTerm
from memmlp.training.losses.mem_mlp import MotionLoss as MotionLoss
from memmlp.training.losses.mem_mlp import NoHandTerm as NoHandTerm
from memmlp.training.losses.mem_mlp import PositionHandTerm as PositionHandTerm
from memmlp.training.losses.mem_mlp import Term as Term
from memmlp.training.losses.mem_mlp import l1 as l1
from memmlp.training.losses.terms import TermsLoss as TermsLoss
