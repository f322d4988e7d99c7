"""The training losses: Mem-MLP's, the baselines', and a library of terms that any network's loss can take."""

from memmlp.training.losses.baseline_losses import AGRoLLoss as AGRoLLoss
from memmlp.training.losses.baseline_losses import AvatarPoserLoss as AvatarPoserLoss
from memmlp.training.losses.baseline_losses import LossOfNetwork as LossOfNetwork
from memmlp.training.losses.baseline_losses import RPMLoss as RPMLoss
from memmlp.training.losses.loss import Fixed as Fixed
from memmlp.training.losses.loss import Loss as Loss
from memmlp.training.losses.loss import Manual as Manual
from memmlp.training.losses.loss import Terms as Terms
from memmlp.training.losses.loss import Uncertainty as Uncertainty
from memmlp.training.losses.loss import Weighting as Weighting
from memmlp.training.losses.loss import joints as joints
from memmlp.training.losses.mem_mlp import HandFK as HandFK
from memmlp.training.losses.mem_mlp import HandPosition as HandPosition
from memmlp.training.losses.mem_mlp import MotionLoss as MotionLoss
from memmlp.training.losses.mem_mlp import NoHand as NoHand
from memmlp.training.losses.mem_mlp import Term as Term
from memmlp.training.losses.mem_mlp import l1 as l1
from memmlp.training.losses.terms import TermsLoss as TermsLoss
