"""The predictor slot: from the backbone's hidden state to motion (Sec. 3.2.2)."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import torch
from torch import Tensor, nn

from memmlp.motion.body import MOTION_DIM, ROTATION
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.layers import MLPBlock

MakeBlock = Callable[[], nn.Module]


class Branch(nn.Module):
    """`depth` MLP blocks and one linear layer to `size` outputs.

    Args:
        hidden, frames: the backbone's d and T. memory_block: makes a memory block.
    """

    def __init__(self, size: int, depth: int, hidden: int, frames: int, memory_block: MakeBlock | None):
        super().__init__()
        self.blocks = nn.ModuleList(self.block(hidden, frames, memory_block) for _ in range(depth))
        self.linear = nn.Linear(hidden, size)

    def block(self, hidden: int, frames: int, memory_block: MakeBlock | None) -> nn.Module:
        """A block of the branch."""
        return MLPBlock(hidden, frames)

    def forward(self, h: Tensor, past: object, newest: int) -> Tensor:
        """Hidden state (B, T, d), what the memory recalls -> the newest frames (B, newest, size)."""
        for block in self.blocks[:-1]:
            h = block(h)
        for block in self.blocks[-1:]:
            assert isinstance(block, MLPBlock)
            h = block.newest(h, newest)
        return self.linear(h[..., -newest:, :])


class MemoryBranch(Branch):
    """Its blocks take memory features in, as the backbone's do (Table 8)."""

    def block(self, hidden: int, frames: int, memory_block: MakeBlock | None) -> nn.Module:
        """A block of the branch."""
        assert memory_block is not None
        return memory_block()

    def forward(self, h: Tensor, past: object, newest: int) -> Tensor:
        """Hidden state (B, T, d), what the memory recalls -> the newest frames (B, newest, size)."""
        for block in self.blocks:
            h = block(h, past)
        return self.linear(h[..., -newest:, :])


class TwoBranch(nn.Module):
    """One branch for rotations, one for positions.

    Args:
        depth: blocks a branch. hidden, frames: the backbone's d and T.
        memory_block: makes a memory block; not used here.
    """

    branches: ClassVar[frozenset[str]] = frozenset({"rotation", "position"})
    kind: ClassVar[type[Branch]] = Branch

    def __init__(self, depth: int, *, hidden: int, frames: int, memory_block: MakeBlock | None = None):
        super().__init__()
        self.rotation = self.kind(ROTATION.stop, depth, hidden, frames, memory_block)
        self.position = self.kind(MOTION_DIM - ROTATION.stop, depth, hidden, frames, memory_block)

    def forward(self, h: Tensor, past: object, sparse: Tensor, normalizer: Normalizer, newest: int) -> Tensor:
        """Hidden state (B, T, d), what the memory recalls -> motion (B, newest, 198) in network space."""
        return torch.cat([self.rotation(h, past, newest), self.position(h, past, newest)], -1)


class TwoBranchMemory(TwoBranch):
    """Memory blocks in both branches (Table 8, "MHP w/ MB")."""

    kind = MemoryBranch


class RotationOnly(nn.Module):
    """Rotations alone; the positions follow from them by forward kinematics, without gradient.

    Args:
        depth, hidden, frames, memory_block: as for TwoBranch.
    """

    branches: ClassVar[frozenset[str]] = frozenset({"rotation"})
    kind: ClassVar[type[Branch]] = Branch

    def __init__(self, depth: int, *, hidden: int, frames: int, memory_block: MakeBlock | None = None):
        super().__init__()
        self.rotation = self.kind(ROTATION.stop, depth, hidden, frames, memory_block)

    def forward(self, h: Tensor, past: object, sparse: Tensor, normalizer: Normalizer, newest: int) -> Tensor:
        """As TwoBranch's; world inputs (B, T, 54) place the body."""
        rotation, sparse = self.rotation(h, past, newest), sparse[..., -newest:, :]
        with torch.no_grad():
            motion = normalizer.encode_motion(normalizer.posed(rotation, sparse), normalizer.origin(sparse))
        position = motion[..., ROTATION.stop :]
        return torch.cat([rotation, position], -1)


class RotationOnlyMemory(RotationOnly):
    """Memory blocks in the one branch: Table 8's question where there is no position branch."""

    kind = MemoryBranch


Predictor = TwoBranch | RotationOnly
