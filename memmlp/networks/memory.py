"""The memory slot: what the backbone sees of the past, and what it keeps for the next call.

A memory makes the backbone's blocks (`block`), turns the buffers of past frames into what those blocks see
(`recall`), and updates its buffers with the network's output (`remember`). All of these values are in network
space.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

from torch import Tensor, nn

from memmlp.common.components import component
from memmlp.common.errors import InputError
from memmlp.common.settings import Settings, at_least, each, one_of, setting
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.layers import MLPBlock, PlainFusion, ResidualFusion
from memmlp.networks.motion_model import State
from memmlp.networks.vqvae import VQVAE


class Past(NamedTuple):
    """What a memory of the network's own past recalls: the T frames that end one shift before the newest.

    Attributes:
        sparse: inputs (B, T, 54).
        motion: the network's motion (B, T, 198).
        codes: code-vectors (B, T, width), of width 0 for a memory without them.
    """

    sparse: Tensor
    motion: Tensor
    codes: Tensor


class RecurrentPast(NamedTuple):
    """What a recurrent memory recalls.

    Attributes:
        features: SiLU of the recurrent layers' outputs in the window (B, blocks, T, k).
        carried: the layers' states after the newest frame, each (B, blocks, k).
    """

    features: Tensor
    carried: State


class MemoryBlock(nn.Module):
    """A block that computes a memory feature from the recalled past, and takes that feature in.

    Args:
        feature: computes the feature (B, T, k).
        fusion: the MLP block that takes it in.
    """

    def __init__(self, feature: nn.Module, fusion: ResidualFusion | PlainFusion):
        super().__init__()
        self.feature = feature
        self.fusion = fusion

    def forward(self, h: Tensor, past: Past | RecurrentPast) -> Tensor:
        """Map the hidden state (B, T, d) to (B, T, d)."""
        return self.fusion.fuse(h, self.feature(past))


class Recall(nn.Module):
    """Computes, for each memory block, what the recalled feature adds to it at a step of a stream.

    Args:
        memory: the network's memory.
        features: the feature modules of its memory blocks.
        parts: the layers that map each block's feature (1, k) to its contribution (1, d).
    """

    def __init__(self, memory: Memory, features: Sequence[Any], parts: Sequence[nn.Module]):
        super().__init__()
        # The memory is asked for windows of one frame: only the frame that enters is new to the stream.
        self.memory = copy.copy(memory)
        self.memory.frames, self.memory.past_frames = 1, memory.past_frames - memory.frames + 1
        self.parts = nn.ModuleList(parts)
        if features:
            self.join(features)

    def join(self, features: Sequence[Any]) -> None:
        """Join the blocks' feature modules into one that computes a frame's features for all of them."""

    def forward(self, past: Past | RecurrentPast | None) -> tuple[Sequence[Tensor], Sequence[Tensor]]:
        """Return each block's contribution (1, d): of the entering frame, and of frames before the first."""
        if not self.parts:
            return (), ()
        z = self.compute_features(past)
        before, made = self.compute_earlier(z), self._multiply(z)
        return made, made if before is z else self._multiply(before)

    def compute_features(self, past: Any) -> Tensor:
        """Return the features (1, blocks, k) of the frame that enters."""
        raise NotImplementedError

    def compute_earlier(self, first: Tensor) -> Tensor:
        """Return the features of frames before the first one, given the first one's (1, blocks, k)."""
        return first

    def _multiply(self, z: Tensor) -> Sequence[Tensor]:
        return [part(of) for part, of in zip(self.parts, z.flatten(0, 1).split(1), strict=True)]


FUSIONS: dict[str, type[ResidualFusion | PlainFusion]] = {"residual": ResidualFusion, "plain": PlainFusion}


class Memory(nn.Module):
    """The memory slot's interface; in this base class nothing is kept and nothing is recalled.

    Args:
        hidden: the backbone's d.
        frames: the backbone's T.
        depth: the backbone's L; not used here.
        codes: the frozen VQ-VAE; not used here.

    Attributes:
        shift: how many frames before the newest one the recalled past ends, which is also how many frames a
            training step moves on; 0 without a past.
        past_frames: how many past frames of inputs the buffer holds; the last one directly precedes the new.
        frames: T, the window's length.
        settled: whether what is recalled of a frame never changes, so that a stream may compute it once. For
            a custom memory that does not set it, only the graph of the network as trained can be exported.
        streaming_recall: what computes the blocks' contributions in a streaming graph.
    """

    streaming_recall: ClassVar[type[Recall]] = Recall

    settled: bool = False

    def __init__(self, *, hidden: int, frames: int, depth: int, codes: VQVAE | None = None):
        super().__init__()
        self.hidden, self.frames = hidden, frames
        self.shift, self.past_frames = 0, frames - 1

    def make_block(self, layer: int) -> nn.Module:
        """Make the backbone's block of a layer (1-based); by default one without memory."""
        return MLPBlock(self.hidden, self.frames)

    def make_memory_block(self) -> nn.Module:
        """Make one more block that takes in a memory feature, for the predictor's branches (Table 8)."""
        raise InputError("memory: must have memory blocks for this predictor, which uses them")

    def initial_state(self, batch: int) -> State:
        """Return the memory's state at a fresh start: zeros."""
        return {}

    def true_state(self, sparse: Tensor, motion: Tensor) -> State:
        """Return the state after inputs (B, past, 54), with the true motion (B, past, 198) as history."""
        return {}

    def count_needed(self, new: int) -> int:
        """Return how many of the output's newest frames `remember` looks at."""
        return 0

    def recall(self, sparse: Tensor, state: State, new: int) -> Past | RecurrentPast | None:
        """Return what the memory blocks see of the past.

        Args:
            sparse: inputs (B, past + new, 54) in network space.
            state: what the last call returned, or `initial_state`.
            new: how many of the inputs are new.
        """
        return None

    def remember(self, motion: Tensor, past: Past | RecurrentPast | None, state: State, new: int) -> State:
        """Return the state after an output.

        Args:
            motion: output (B, n, 198), n at least `count_needed(new)`.
            past: what `recall` returned.
            state: the state before the new frames.
            new: how many of the output's last frames are new.
        """
        return {}

    def auxiliary_losses(self, frames: Tensor, normalizer: Normalizer) -> dict[str, Tensor]:
        """Return the memory's own losses on true world frames (B, T, 252); they add to the network's."""
        return {}


@component("memory", "none")
class NoMemory(Memory):
    """The empty memory: plain blocks, no past, no state."""

    settled = True


@dataclass
class FeatureMemorySettings(Settings):
    """The keys of the memories that give some blocks a feature to take in."""

    # which blocks of the backbone have it: the even ones (Sec. 4.1)
    layers: list[int] = setting(each(at_least(1)), "${even_layers:${model.depth}}")
    # k, the width of the memory feature (reading 3), and the hidden size of a recurrent memory
    width: int = setting(at_least(1), tiny=8, small=48, paper=192, width_fraction=0.375)
    # residual: x + f([x; z]); plain: Linear([block(x); z]), as Sec. 4.1 says (reading 3)
    fusion: str = setting(one_of("residual", "plain"), "residual", literal="plain")


class FeatureMemory(Memory):
    """A memory that gives some blocks a feature to take in.

    Args:
        settings: the memory's keys, of which `layers`, `width` and `fusion` are used here.
        depth: the backbone's L.
        sizes: the other arguments of Memory.

    Raises:
        InputError: if a layer is not one of the backbone's.
    """

    def __init__(self, settings: Any, *, depth: int, **sizes: Any):
        super().__init__(depth=depth, **sizes)
        self.layers, self.width, self.fusion = settings.layers, settings.width, FUSIONS[settings.fusion]
        if not set(self.layers) <= set(range(1, depth + 1)):
            raise InputError(f"memory.layers={self.layers}: must be layers of the backbone, 1 to {depth}")

    def make_block(self, layer: int) -> nn.Module:
        return self.make_memory_block() if layer in self.layers else super().make_block(layer)

    def make_memory_block(self) -> nn.Module:
        return MemoryBlock(self.make_feature(), self.fusion(self.hidden, self.frames, self.width))

    def make_feature(self) -> nn.Module:
        """Make the module that computes a block's memory feature from what `recall` returns."""
        raise NotImplementedError
