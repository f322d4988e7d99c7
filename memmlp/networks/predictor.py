"""The predictor slot: maps the backbone's hidden state to motion (Sec. 3.2.2)."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import torch
from torch import Tensor, nn

from memmlp.common.components import component
from memmlp.common.settings import Settings, at_least, setting
from memmlp.motion.body import MOTION_DIM, ROTATION
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.layers import MLPBlock, take_newest

MakeBlock = Callable[[], nn.Module]


class Branch(nn.Module):
    """A branch of the predictor: `depth` blocks and one linear layer.

    Args:
        size: number of outputs.
        depth: number of blocks.
        hidden: the backbone's d.
        frames: the backbone's T.
        memory_block: makes memory blocks like the backbone's (Table 8); None for MLP blocks.
    """

    def __init__(self, size: int, depth: int, hidden: int, frames: int, memory_block: MakeBlock | None):
        super().__init__()
        make = memory_block or partial(MLPBlock, hidden, frames)
        self.blocks = nn.ModuleList(make() for _ in range(depth))
        self.linear = nn.Linear(hidden, size)

    def forward(self, h: Tensor, past: object, newest: int) -> Tensor:
        """Map the hidden state (B, T, d) and the recalled past to outputs (B, newest, size)."""
        for block in self.blocks[:-1]:
            h = block(h, past)
        for last in self.blocks[-1:]:
            h = last.compute_newest(h, newest) if isinstance(last, MLPBlock) else last(h, past)
        return self.linear(take_newest(h, newest))


@component("predictor", "two_branch", builds="TwoBranch")
@dataclass
class TwoBranchSettings(Settings):
    """A branch for rotations and a branch for positions (Sec. 3.2.2)."""

    depth: int = setting(at_least(0), 2)  # number of MLP blocks in each branch (Sec. 4.1)

    positions: ClassVar[bool] = True
    memory_blocks: ClassVar[bool] = False


@component("predictor", "two_branch_memory", builds="TwoBranch")
@dataclass
class TwoBranchMemorySettings(TwoBranchSettings):
    """Like two_branch, but with memory blocks in both branches (Table 8, "MHP w/ MB").

    It needs a memory.
    """

    depth: int = setting(at_least(1), 2)  # number of memory blocks in each branch

    memory_blocks: ClassVar[bool] = True


@component("predictor", "rotation_only", builds="RotationOnly")
@dataclass
class RotationOnlySettings(TwoBranchSettings):
    """Only a rotation branch (Table 4). Positions follow by forward kinematics.

    It needs hand=fk or hand=off.
    """

    positions: ClassVar[bool] = False


@component("predictor", "rotation_only_memory", builds="RotationOnly")
@dataclass
class RotationOnlyMemorySettings(TwoBranchMemorySettings):
    """Only a rotation branch, of memory blocks. It needs a memory, and hand=fk or hand=off."""

    positions: ClassVar[bool] = False


class Predictor(nn.Module):
    """A predictor with a rotation branch, and a position branch if `branches` includes "position".

    Args:
        settings: the predictor's settings.
        hidden: the backbone's d.
        frames: the backbone's T.
        memory_block: makes a memory block.

    Attributes:
        branches: the quantities with a branch: "rotation", and optionally "position". Without a position
            branch, positions follow by forward kinematics, without gradients.
    """

    branches: ClassVar[frozenset[str]] = frozenset({"rotation", "position"})

    def __init__(
        self, settings: TwoBranchSettings, *, hidden: int, frames: int, memory_block: MakeBlock | None = None
    ):
        super().__init__()
        make = memory_block if settings.memory_blocks else None
        self.rotation = Branch(ROTATION.stop, settings.depth, hidden, frames, make)
        if "position" in self.branches:
            self.position = Branch(MOTION_DIM - ROTATION.stop, settings.depth, hidden, frames, make)

    def forward(self, h: Tensor, past: object, sparse: Tensor, normalizer: Normalizer, newest: int) -> Tensor:
        """Predict the newest frames' motion.

        Args:
            h: hidden state (B, T, d).
            past: the memory's recalled past.
            sparse: world inputs (B, T, 54); the head position places the body.
            normalizer: converts between the world and network space.
            newest: number of newest frames to predict.

        Returns:
            Motion (B, newest, 198) in network space.
        """
        rotation = self.rotation(h, past, newest)
        if "position" in self.branches:
            return torch.cat([rotation, self.position(h, past, newest)], -1)
        sparse = sparse[..., -newest:, :]
        posed = normalizer.decode_rotations(rotation.detach(), sparse)
        motion = normalizer.encode_motion(posed, normalizer.find_origin(sparse))
        return torch.cat([rotation, motion[..., ROTATION.stop :]], -1)


class TwoBranch(Predictor):
    """A predictor with a rotation branch and a position branch."""


class RotationOnly(Predictor):
    """A predictor with only a rotation branch."""

    branches = frozenset({"rotation"})
