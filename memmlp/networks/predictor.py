"""The predictor slot: maps the backbone's hidden state to motion (Sec. 3.2.2)."""

from __future__ import annotations

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
from memmlp.networks.layers import MLPBlock

MakeBlock = Callable[[], nn.Module]


class Branch(nn.Module):
    """A branch of the predictor: `depth` blocks and one linear layer.

    Args:
        size: number of outputs.
        depth: number of blocks.
        hidden: the backbone's d.
        frames: the backbone's T.
        memory_block: makes the blocks, which see memory features like those of the backbone (Table 8); None
            for MLP blocks.
    """

    def __init__(self, size: int, depth: int, hidden: int, frames: int, memory_block: MakeBlock | None):
        super().__init__()
        make = memory_block or partial(MLPBlock, hidden, frames)
        self.blocks = nn.ModuleList(make() for _ in range(depth))
        self.linear = nn.Linear(hidden, size)

    def forward(self, h: Tensor, past: object, newest: int) -> Tensor:
        """Map the hidden state (B, T, d) and the recalled past to the newest frames' (B, newest, size)."""
        for block in self.blocks[:-1]:
            h = block(h, past)
        for last in self.blocks[-1:]:
            h = last.newest(h, newest) if isinstance(last, MLPBlock) else last(h, past)
        return self.linear(h[..., -newest:, :])


@component("predictor", "two_branch", builds="TwoBranch")
@dataclass
class TwoBranchSettings(Settings):
    """Rotations and positions, with a branch for each (Sec. 3.2.2)."""

    depth: int = setting(at_least(0), 2)  # MLP blocks in each branch (Sec. 4.1)

    positions: ClassVar[bool] = True
    memory_blocks: ClassVar[bool] = False


@component("predictor", "two_branch_memory", builds="TwoBranch")
@dataclass
class TwoBranchMemorySettings(TwoBranchSettings):
    """Rotations and positions, with a branch of memory blocks for each (Table 8, "MHP w/ MB").

    It needs a memory.
    """

    depth: int = setting(at_least(1), 2)  # memory blocks in each branch

    memory_blocks: ClassVar[bool] = True


@component("predictor", "rotation_only", builds="RotationOnly")
@dataclass
class RotationOnlySettings(TwoBranchSettings):
    """Rotations alone (Table 4); positions follow by forward kinematics. It needs hand=fk or hand=off."""

    positions: ClassVar[bool] = False


@component("predictor", "rotation_only_memory", builds="RotationOnly")
@dataclass
class RotationOnlyMemorySettings(TwoBranchMemorySettings):
    """Rotations alone, by a branch of memory blocks. It needs a memory, and hand=fk or hand=off."""

    positions: ClassVar[bool] = False


class Predictor(nn.Module):
    """A branch for the rotations, and one for the positions where `branches` has them.

    Args:
        settings: the predictor's keys, and whether its branches consist of memory blocks.
        hidden: the backbone's d.
        frames: the backbone's T.
        memory_block: makes a memory block.

    Attributes:
        branches: the parts of the motion that have a branch, "rotation" and perhaps "position". Without the
            latter, positions follow by forward kinematics, without gradients.
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
            past: what the memory recalls.
            sparse: world inputs (B, T, 54), whose head position says where the body is.
            normalizer: converts between the world and network space.
            newest: how many of the newest frames are wanted.

        Returns:
            Motion (B, newest, 198) in network space.
        """
        rotation = self.rotation(h, past, newest)
        if "position" in self.branches:
            return torch.cat([rotation, self.position(h, past, newest)], -1)
        sparse = sparse[..., -newest:, :]
        posed = normalizer.posed(rotation.detach(), sparse)
        motion = normalizer.encode_motion(posed, normalizer.origin(sparse))
        return torch.cat([rotation, motion[..., ROTATION.stop :]], -1)


class TwoBranch(Predictor):
    """One branch for the rotations and one for the positions."""


class RotationOnly(Predictor):
    """One branch for the rotations."""

    branches = frozenset({"rotation"})
