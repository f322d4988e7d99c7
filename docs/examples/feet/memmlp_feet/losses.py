"""A loss term: the feet move as much as they do in truth."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from memmlp.common.components import component
from memmlp.common.settings import Settings, at_least, setting
from memmlp.motion.body import JOINTS
from memmlp.motion.normalizer import Normalizer
from memmlp.training.losses import Term, Terms, joints, l1

FEET = [JOINTS.index("left_foot"), JOINTS.index("right_foot")]


@component("term", "skate", builds="FootSkate")
@dataclass
class FootSkateSettings(Settings):
    """term=skate: the velocity of both feet."""

    weight: float = setting(at_least(0), 0.1)  # with loss=manual; loss=uncertainty learns one


class FootSkate(Term):
    """L1 on the velocity of both feet in the position branch, metres a frame."""

    branch = "position"

    def __call__(self, motion: Tensor, truth: Tensor, sparse: Tensor, normalizer: Normalizer) -> Terms:
        """Return the term for motion and truth (B, T, 198)."""
        error = (joints(motion) - joints(truth))[:, :, FEET]
        return {"skate": l1(error.diff(dim=1))}
