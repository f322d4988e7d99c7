"""The memory slot's interface, the empty memory, and the base of memories that give blocks a feature."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

from torch import Tensor, nn

from memmlp.common.errors import InputError
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.layers import MLPBlock, PlainFusion, ResidualFusion
from memmlp.networks.memory.memory_block import MemoryBlock, Past, Recurred, State
from memmlp.networks.vqvae import VQVAE

FUSIONS: dict[str, type[ResidualFusion | PlainFusion]] = {"residual": ResidualFusion, "plain": PlainFusion}


class Memory(nn.Module):
    """The memory slot's interface; in this base class nothing is kept and nothing is recalled.

    Attributes:
        uses_codes: whether the memory needs a frozen VQ-VAE.
        trains_codes: whether it has a VQ-VAE of its own that is trained with the network.
        shift: how many frames before the newest one the recalled past ends, which is also how many frames a
            training step moves on; 0 without a past.
        past_frames: how many past frames of inputs the buffer holds; the last one directly precedes the new.
        frames: T, the window's length.
        settled: whether what is recalled of a frame never changes, so that a stream may compute it once. For
            a custom memory that does not set it, only the graph of the network as trained can be exported.
    """

    uses_codes: ClassVar[bool] = False
    trains_codes: ClassVar[bool] = False
    shift: int
    past_frames: int
    frames: int
    settled: bool = False

    def block(self, layer: int) -> nn.Module:
        """Make the backbone's block of a layer (1-based)."""
        raise NotImplementedError

    def memory_block(self) -> nn.Module:
        """Make one more block that takes in a memory feature, for the predictor's branches (Table 8)."""
        raise NotImplementedError

    def initial_state(self, batch: int) -> State:
        """Return the memory's state at a fresh start: zeros."""
        return {}

    def true_state(self, sparse: Tensor, motion: Tensor) -> State:
        """Return the state after inputs (B, past, 54), with the true motion (B, past, 198) as history."""
        return {}

    def needed(self, new: int) -> int:
        """Return how many of the output's newest frames `remember` looks at."""
        return 0

    def recall(self, sparse: Tensor, state: State, new: int) -> Past | Recurred | None:
        """Return what the memory blocks see of the past.

        Args:
            sparse: inputs (B, past + new, 54) in network space.
            state: what the last call returned, or `initial_state`.
            new: how many of the inputs are new.
        """
        return None

    def remember(self, motion: Tensor, past: Past | Recurred | None, state: State, new: int) -> State:
        """Return the state after an output.

        Args:
            motion: output (B, n, 198), n at least `needed(new)`.
            past: what `recall` returned.
            state: the state before the new frames.
            new: how many of the output's last frames are new.
        """
        return {}

    def auxiliary_losses(self, frames: Tensor, normalizer: Normalizer) -> dict[str, Tensor]:
        """Return the memory's own losses on true world frames (B, T, 252); they add to the network's."""
        return {}


class NoMemory(Memory):
    """The empty memory: plain blocks, no past, no state.

    Args:
        hidden: the backbone's d.
        frames: the backbone's T.
        depth: the backbone's L; not used here.
        codes: the frozen VQ-VAE; not used here.
    """

    settled = True

    def __init__(self, *, hidden: int, frames: int, depth: int, codes: VQVAE | None = None):
        super().__init__()
        self.hidden, self.frames = hidden, frames
        self.shift = 0
        self.past_frames = frames - 1

    def block(self, layer: int) -> nn.Module:
        """Make the backbone's block of a layer (1-based)."""
        return MLPBlock(self.hidden, self.frames)

    def memory_block(self) -> nn.Module:
        """Raise InputError, since this memory has no memory blocks."""
        raise InputError("memory=none has no memory blocks: allowed is a predictor without memory")


class FeatureMemory(Memory):
    """A memory that gives some blocks a feature to take in.

    Args:
        layers: the backbone's layers (1-based) that get a memory feature.
        width: k, the width of the memory feature.
        fusion: "residual" or "plain".
        hidden: the backbone's d.
        frames: the backbone's T.
        depth: the backbone's L.

    Raises:
        InputError: if a layer is not one of the backbone's.
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
        """Make the backbone's block of a layer (1-based)."""
        return self.memory_block() if layer in self.layers else MLPBlock(self.hidden, self.frames)

    def memory_block(self) -> nn.Module:
        """Make a block that takes in a memory feature."""
        return MemoryBlock(self.feature(), self.fusion(self.hidden, self.frames, self.width))

    def feature(self) -> nn.Module:
        """Make the module that computes a block's memory feature from what `recall` returns."""
        raise NotImplementedError
