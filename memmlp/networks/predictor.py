"""The predictor slot: maps the backbone's hidden state to motion (Sec. 3.2.2)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
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
    """A branch of the predictor: `depth` MLP blocks and one linear layer.

    Args:
        size: number of outputs.
        depth: number of blocks.
        hidden: the backbone's d.
        frames: the backbone's T.
        memory_block: makes a memory block; not used here.
    """

    def __init__(self, size: int, depth: int, hidden: int, frames: int, memory_block: MakeBlock | None):
        super().__init__()
        self.blocks = nn.ModuleList(self.block(hidden, frames, memory_block) for _ in range(depth))
        self.linear = nn.Linear(hidden, size)

    def block(self, hidden: int, frames: int, memory_block: MakeBlock | None) -> nn.Module:
        """Make one of the branch's blocks."""
        return MLPBlock(hidden, frames)

    def forward(self, h: Tensor, past: object, newest: int) -> Tensor:
        """Map the hidden state (B, T, d) to the newest frames' (B, newest, size); `past` is ignored."""
        for block in self.blocks[:-1]:
            h = block(h)
        for block in self.blocks[-1:]:
            assert isinstance(block, MLPBlock)
            h = block.newest(h, newest)
        return self.linear(h[..., -newest:, :])


class MemoryBranch(Branch):
    """A branch whose blocks take in memory features, as those of the backbone do (Table 8)."""

    def block(self, hidden: int, frames: int, memory_block: MakeBlock | None) -> nn.Module:
        """Make one of the branch's blocks, which is a memory block."""
        assert memory_block is not None
        return memory_block()

    def forward(self, h: Tensor, past: object, newest: int) -> Tensor:
        """Map the hidden state (B, T, d) and the recalled past to the newest frames' (B, newest, size)."""
        for block in self.blocks:
            h = block(h, past)
        return self.linear(h[..., -newest:, :])


@component("predictor", "two_branch", builds="TwoBranch")
@dataclass
class TwoBranchSettings(Settings):
    """Rotations and positions, with a branch for each (Sec. 3.2.2)."""

    depth: int = setting(at_least(0), 2)  # MLP blocks in each branch (Sec. 4.1)

    positions: ClassVar[bool] = True
    memory_blocks: ClassVar[bool] = False


@component("predictor", "two_branch_memory", builds="TwoBranchMemory")
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


@component("predictor", "rotation_only_memory", builds="RotationOnlyMemory")
@dataclass
class RotationOnlyMemorySettings(TwoBranchMemorySettings):
    """Rotations alone, by a branch of memory blocks. It needs a memory, and hand=fk or hand=off."""

    positions: ClassVar[bool] = False


class TwoBranch(nn.Module):
    """One branch for the rotations and one for the positions.

    Args:
        depth: number of blocks in each branch.
        hidden: the backbone's d.
        frames: the backbone's T.
        memory_block: makes a memory block; not used here.
    """

    branches: ClassVar[frozenset[str]] = frozenset({"rotation", "position"})
    kind: ClassVar[type[Branch]] = Branch

    def __init__(self, depth: int, *, hidden: int, frames: int, memory_block: MakeBlock | None = None):
        super().__init__()
        self.rotation = self.kind(ROTATION.stop, depth, hidden, frames, memory_block)
        self.position = self.kind(MOTION_DIM - ROTATION.stop, depth, hidden, frames, memory_block)

    def forward(self, h: Tensor, past: object, sparse: Tensor, normalizer: Normalizer, newest: int) -> Tensor:
        """Predict the newest frames' motion.

        Args:
            h: hidden state (B, T, d).
            past: what the memory recalls.
            sparse: not used here.
            normalizer: not used here.
            newest: how many of the newest frames are wanted.

        Returns:
            Motion (B, newest, 198) in network space.
        """
        return torch.cat([self.rotation(h, past, newest), self.position(h, past, newest)], -1)


class TwoBranchMemory(TwoBranch):
    """Two branches, both of memory blocks (Table 8, "MHP w/ MB")."""

    kind = MemoryBranch


class RotationOnly(nn.Module):
    """One branch for the rotations; positions follow by forward kinematics, without gradients.

    Args:
        depth: number of blocks.
        hidden: the backbone's d.
        frames: the backbone's T.
        memory_block: makes a memory block; not used here.
    """

    branches: ClassVar[frozenset[str]] = frozenset({"rotation"})
    kind: ClassVar[type[Branch]] = Branch

    def __init__(self, depth: int, *, hidden: int, frames: int, memory_block: MakeBlock | None = None):
        super().__init__()
        self.rotation = self.kind(ROTATION.stop, depth, hidden, frames, memory_block)

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
        rotation, sparse = self.rotation(h, past, newest), sparse[..., -newest:, :]
        posed = normalizer.posed(rotation.detach(), sparse)
        motion = normalizer.encode_motion(posed, normalizer.origin(sparse))
        position = motion[..., ROTATION.stop :]
        return torch.cat([rotation, position], -1)


class RotationOnlyMemory(RotationOnly):
    """One rotation branch of memory blocks: Table 8's comparison without a position branch."""

    kind = MemoryBranch


Predictor = TwoBranch | RotationOnly
