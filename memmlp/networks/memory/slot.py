"""The memory slot's interface, the empty slot, and memories that give blocks a feature."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

from torch import Tensor, nn

from memmlp.common.errors import InputError
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.layers import MLPBlock, PlainFusion, ResidualFusion
from memmlp.networks.memory.features import MemoryBlock, Past, Recurred, State
from memmlp.networks.vqvae import VQVAE

FUSIONS: dict[str, type[ResidualFusion | PlainFusion]] = {"residual": ResidualFusion, "plain": PlainFusion}


class Memory(nn.Module):
    """The slot's interface; as it stands, nothing is kept and nothing recalled.

    Attributes:
        uses_codes: wants a frozen VQ-VAE. trains_codes: has one of its own, trained with the network.
        shift: frames by which the past ends before the newest and a training step moves; 0 without a past.
        length: frames of inputs in the buffer, the last one just before the new ones.
        frames: T, the window's length.
        settled: what is recalled of a frame never changes, so that a stream may compute it once.
    """

    uses_codes: ClassVar[bool] = False
    trains_codes: ClassVar[bool] = False
    shift: int
    length: int
    frames: int
    settled: bool = True

    def block(self, layer: int) -> nn.Module:
        """The backbone's block of that layer (1-based)."""
        raise NotImplementedError

    def memory_block(self) -> nn.Module:
        """One more block that takes a memory feature in: for the predictor's branches (Table 8)."""
        raise NotImplementedError

    def initial_state(self, batch: int) -> State:
        """What is kept at a fresh start: zeros."""
        return {}

    def true_state(self, sparse: Tensor, motion: Tensor) -> State:
        """The state after inputs (B, length, 54) with the true motion (B, length, 198): teacher forcing."""
        return {}

    def needed(self, new: int) -> int:
        """How many of the output's newest frames `remember` looks at."""
        return 0

    def recall(self, sparse: Tensor, state: State, new: int) -> Past | Recurred | None:
        """What the blocks see at inputs (B, length + new, 54) whose last `new` frames are new."""
        return None

    def remember(self, motion: Tensor, past: Past | Recurred | None, state: State, new: int) -> State:
        """The state after an output (B, at least `needed`, 198) whose last `new` frames are new."""
        return {}

    def auxiliary_losses(self, frames: Tensor, normalizer: Normalizer) -> dict[str, Tensor]:
        """Losses of its own at true world frames (B, T, 252), added to the network's."""
        return {}


class NoMemory(Memory):
    """The empty slot: plain blocks, no past, no state."""

    def __init__(self, *, hidden: int, frames: int, depth: int, codes: VQVAE | None = None):
        super().__init__()
        self.hidden, self.frames = hidden, frames
        self.shift = 0
        self.length = frames - 1

    def block(self, layer: int) -> nn.Module:
        """The backbone's block of that layer (1-based)."""
        return MLPBlock(self.hidden, self.frames)

    def memory_block(self) -> nn.Module:
        """There is none. Raises InputError."""
        raise InputError("memory=none has no memory blocks: allowed is a predictor without memory")


class FeatureMemory(Memory):
    """A memory that gives some blocks a feature to take in.

    Args:
        layers: the backbone's layers (1-based) that get a memory feature.
        width: k, the width of the memory feature.
        fusion: "residual" or "plain".
        hidden, frames, depth: the backbone's d, T and L.
    """

    def __init__(
        self, layers: Sequence[int], width: int, fusion: str, *, hidden: int, frames: int, depth: int
    ):
        super().__init__()
        if not set(layers) <= set(range(1, depth + 1)):
            raise InputError(f"memory.layers: {list(layers)} is not within the backbone's 1..{depth}")
        self.layers, self.width, self.fusion = tuple(layers), width, FUSIONS[fusion]
        self.hidden, self.frames = hidden, frames

    def block(self, layer: int) -> nn.Module:
        """The backbone's block of that layer (1-based)."""
        return self.memory_block() if layer in self.layers else MLPBlock(self.hidden, self.frames)

    def memory_block(self) -> nn.Module:
        """A block that takes a memory feature in."""
        return MemoryBlock(self.feature(), self.fusion(self.hidden, self.frames, self.width))

    def feature(self) -> nn.Module:
        """The module that makes a block's memory feature of what `recall` gives."""
        raise NotImplementedError
