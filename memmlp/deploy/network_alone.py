"""A network alone, from features to its own outputs, which is what papers time.

The deployed step also converts coordinates, and makes joints by forward kinematics.
"""

from __future__ import annotations

import copy
from typing import TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor

from memmlp.motion.body import MOTION_DIM, N_JOINTS, POSITION, ROTATION
from memmlp.motion.normalizer import Change, Normalizer
from memmlp.networks.motion_model import MotionModel

Model = TypeVar("Model", bound=MotionModel)


class NoConversion(Normalizer):
    """A normalizer that changes nothing: inputs are features already, outputs stay in network space."""

    def encode_sparse(self, sparse: Tensor, origin: Tensor) -> Tensor:
        """Return the inputs (..., 54) unchanged."""
        return sparse

    def encode_motion(self, motion: Tensor, origin: Tensor) -> Tensor:
        """Return the motion (..., 198) unchanged."""
        return motion

    def decode_motion(self, motion: Tensor, origin: Tensor) -> Tensor:
        """Return the motion (..., 198) unchanged."""
        return motion

    def rotations_out(self, rotations: Tensor, origin: Tensor) -> Tensor:
        """Return the rotations (..., 6 n) unchanged."""
        return rotations

    def posed(self, rotation: Tensor, sparse: Tensor) -> Tensor:
        """Return the rotations (..., 132) as motion (..., 198) whose positions are zeros."""
        return F.pad(rotation, (0, MOTION_DIM - ROTATION.stop))

    def posed_in_world(self, rotations: Tensor, sparse: Tensor, change: Change | None = None) -> Tensor:
        """Return the rotations (..., 132) as motion (..., 198) whose positions are zeros."""
        return self.posed(rotations, sparse)

    def pose(self, motion: Tensor, sparse: Tensor) -> Tensor:
        """Return zeros (..., 22, 3) in place of joint positions."""
        return torch.zeros_like(motion[..., POSITION]).unflatten(-1, (N_JOINTS, 3))


def network_alone(model: Model) -> Model:
    """Copy a network without the conversions before and after it and without its forward kinematics.

    What a network does with joints between its own layers (AvatarJLM's tokens, MANIKIN's limbs) belongs to
    the network and stays. The copy is only good for timing.
    """
    made = copy.deepcopy(model)
    for module in list(made.modules()):
        for name, child in module.named_children():
            if isinstance(child, Normalizer):
                setattr(module, name, NoConversion(child.coordinates, child.rest, child.mean, child.std))
    return made
