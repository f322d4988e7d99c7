"""The predictor slot: from the backbone's hidden state to motion (Sec. 3.2.2)."""

from __future__ import annotations

from typing import ClassVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.body import MOTION_DIM, ROTATION
from memmlp.features import Frame
from memmlp.layers import MLPBlock


class Branch(nn.Module):
    """`depth` MLP blocks and one linear layer."""

    def __init__(self, hidden: int, frames: int, depth: int, size: int):
        super().__init__()
        self.blocks = nn.ModuleList(MLPBlock(hidden, frames) for _ in range(depth))
        self.linear = nn.Linear(hidden, size)

    def forward(self, h: Tensor, newest: int) -> Tensor:
        """Hidden state (B, T, d) -> the newest frames (B, newest, size)."""
        for block in self.blocks[:-1]:
            h = block(h)
        for block in self.blocks[-1:]:
            assert isinstance(block, MLPBlock)
            h = block.newest(h, newest)
        return self.linear(h[:, -newest:])


class TwoBranch(nn.Module):
    """One branch for rotations, one for positions.

    Args:
        depth: MLP blocks a branch. hidden, frames: the backbone's d and T.
    """

    branches: ClassVar[frozenset[str]] = frozenset({"rotation", "position"})

    def __init__(self, depth: int, *, hidden: int, frames: int):
        super().__init__()
        self.rotation = Branch(hidden, frames, depth, ROTATION.stop)
        self.position = Branch(hidden, frames, depth, MOTION_DIM - ROTATION.stop)

    def forward(self, h: Tensor, sparse: Tensor, frame: Frame, newest: int) -> Tensor:
        """Hidden state (B, T, d) -> motion of the newest frames (B, newest, 198) in network space."""
        return torch.cat([self.rotation(h, newest), self.position(h, newest)], -1)


class RotationOnly(nn.Module):
    """Rotations alone; the positions follow from them by forward kinematics, without gradient."""

    branches: ClassVar[frozenset[str]] = frozenset({"rotation"})

    def __init__(self, depth: int, *, hidden: int, frames: int):
        super().__init__()
        self.rotation = Branch(hidden, frames, depth, ROTATION.stop)

    def forward(self, h: Tensor, sparse: Tensor, frame: Frame, newest: int) -> Tensor:
        """Hidden state (B, T, d), world inputs (B, T, 54) -> motion (B, newest, 198) in network space."""
        rotation, sparse = self.rotation(h, newest), sparse[:, -newest:]
        with torch.no_grad():
            place = frame.place(sparse)
            world = frame.decode_motion(F.pad(rotation, (0, MOTION_DIM - ROTATION.stop)), place)
            positions = frame.pose(world, sparse).flatten(-2)
            world = torch.cat([world[..., ROTATION], positions], -1)
            position = frame.encode_motion(world, place)[..., ROTATION.stop :]
        return torch.cat([rotation, position], -1)


Predictor = TwoBranch | RotationOnly
