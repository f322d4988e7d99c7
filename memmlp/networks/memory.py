"""The memory slot: what the backbone sees of the past, and what it keeps for the next call.

A memory makes the backbone's blocks (`block`), turns the buffers of past frames into what those blocks see
(`recall`), and updates its buffers with the network's output (`remember`). All of these values are in network
space. Here are the interface, and memories of recurrent layers, which replace the paper's memory (Table 15).
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.common.components import component
from memmlp.common.errors import InputError
from memmlp.common.settings import Settings, at_least, each, one_of, setting
from memmlp.motion.body import SPARSE_DIM
from memmlp.motion.normalizer import Normalizer, in_float32
from memmlp.networks.layers import MLPBlock, PlainFusion, ResidualFusion
from memmlp.networks.motion_model import State
from memmlp.networks.streaming import FrameGRU
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


class Recurrence(nn.Module):
    """LayerNorm of the sparse features, a recurrent layer, SiLU (App. A, reading 19).

    Args:
        kind: the class of the recurrent layer, nn.LSTM or nn.GRU.
        width: k, the layer's hidden size.
    """

    def __init__(self, kind: type[nn.LSTM] | type[nn.GRU], width: int):
        super().__init__()
        self.norm = nn.LayerNorm(SPARSE_DIM)
        self.first = nn.Linear(SPARSE_DIM, width)
        self.layer: nn.Module = kind(SPARSE_DIM, width, batch_first=True)

    def begin(self, sparse: Tensor) -> Tensor:
        """Map the input (B, 54) just before a training window to the hidden state (B, k) to start from."""
        return self.first(self.norm(sparse))

    def forward(self, sparse: Tensor, carried: Sequence[Tensor]) -> tuple[Tensor, Sequence[Tensor]]:
        """Run over the inputs (B, n, 54) from the carried states, each (B, k), the hidden one first.

        Returns:
            Features (B, n, k), and the states after the last input.
        """
        states = tuple(state.contiguous()[None] for state in carried)
        single = len(states) == 1  # a GRU, which takes and returns its one state as a tensor
        with in_float32(sparse.device):  # not every CPU has an LSTM in bfloat16
            output, after = self.layer(self.norm(sparse), states[0] if single else states)
        return F.silu(output), [state[0] for state in ([after] if single else after)]


class RecurrentFeature(nn.Module):
    """The output of a recurrent memory's layer of the given index."""

    def __init__(self, index: int):
        super().__init__()
        self.index = index

    def forward(self, past: RecurrentPast) -> Tensor:
        """Return the memory feature (B, T, k)."""
        return past.features[:, self.index]


class RecurrentRecall(Recall):
    """Recall for recurrent memories, whose features before the first frame are zeros."""

    def join(self, features: Sequence[Any]) -> None:
        """Note the index of each block's recurrent layer, and replace GRUs by plain layers."""
        self.layers = [feature.index for feature in features]
        assert isinstance(self.memory, RecurrentMemory)
        for recurrence in self.memory.recurrences:
            if isinstance(recurrence.layer, nn.GRU):
                recurrence.layer = FrameGRU(recurrence.layer)

    def compute_features(self, past: RecurrentPast) -> Tensor:
        newest = past.features[:, :, -1]
        return newest.index_select(1, torch.tensor(self.layers, device=newest.device))

    def compute_earlier(self, first: Tensor) -> Tensor:
        """Return zeros, since the layers have seen nothing before the first frame."""
        return torch.zeros_like(first)


class RecurrentMemory(FeatureMemory):
    """A recurrent layer for each memory block in place of the paper's memory (Table 15, reading 19).

    A layer runs once over each frame, and its outputs for the window's older frames are kept with its states.
    So a stream in single frames is the same as one in larger steps. A training call sees a whole window. With
    teacher forcing the hidden state starts from the last input before the window, projected, and the cell at
    zero (`true_state`). Otherwise, and in evaluation, the states are carried from call to call and are zeros
    at a fresh start.

    Args:
        settings: the memory's keys; k is also the hidden size of the recurrent layers.
        sizes: the other arguments of FeatureMemory.
    """

    streaming_recall = RecurrentRecall
    settled = True
    layer: ClassVar[type[nn.LSTM] | type[nn.GRU]]
    carried: ClassVar[tuple[str, ...]]  # the names of the layer's states, the hidden one first

    def __init__(self, settings: LSTMMemorySettings, **sizes: Any):
        super().__init__(settings, **sizes)
        self.recurrences = nn.ModuleList()
        self.shift = self.frames

    def make_feature(self) -> nn.Module:
        """Add one more recurrent layer and make the module that looks up its output."""
        self.recurrences.append(Recurrence(self.layer, self.width))
        return RecurrentFeature(len(self.recurrences) - 1)

    def initial_state(self, batch: int) -> State:
        """Return zeros: states (B, blocks, k), and the earlier frames' features (B, blocks, T - 1, k)."""
        blocks = len(self.recurrences)
        states = {name: torch.zeros(batch, blocks, self.width) for name in self.carried}
        return states | {"features": torch.zeros(batch, blocks, self.frames - 1, self.width)}

    def true_state(self, sparse: Tensor, motion: Tensor) -> State:
        """Return hidden states projected from the last of the inputs (B, past, 54), for teacher forcing."""
        hidden = [cast(Recurrence, one).begin(sparse[:, -1]) for one in self.recurrences]
        return {"hidden": torch.stack(hidden, 1).float()}

    def recall(self, sparse: Tensor, state: State, new: int) -> RecurrentPast:
        """Run the layers over the `new` last inputs of (B, past + new, 54), and recall the window."""
        features, states = [], []
        for index, recurrence in enumerate(self.recurrences):
            made, after = recurrence(sparse[:, -new:], [state[name][:, index] for name in self.carried])
            features.append(made)
            states.append(after)
        window = torch.cat([state["features"], torch.stack(features, 1)], 2)[:, :, -self.frames :]
        after = (torch.stack(of, 1) for of in zip(*states, strict=True))
        return RecurrentPast(window, dict(zip(self.carried, after, strict=True)))

    def remember(self, motion: Tensor, past: Past | RecurrentPast | None, state: State, new: int) -> State:
        """Return the states after the newest frame, and the features of the last T - 1 frames."""
        assert isinstance(past, RecurrentPast)
        return past.carried | {"features": past.features[:, :, 1:]}


@component("memory", "lstm", builds="LSTMMemory")
@dataclass
class LSTMMemorySettings(FeatureMemorySettings):
    """An LSTM for each memory block (Table 15, reading 19): LayerNorm of the sparse features, LSTM, SiLU.

    Teacher forcing starts its states from the input before the window; evaluation carries them on.
    """


@component("memory", "gru", builds="GRUMemory")
@dataclass
class GRUMemorySettings(LSTMMemorySettings):
    """A GRU for each memory block (Table 15, reading 19), in place of the LSTM of memory=lstm."""


class LSTMMemory(RecurrentMemory):
    """A memory of LSTM layers (Table 15's LSTM-MB)."""

    layer, carried = nn.LSTM, ("hidden", "cell")


class GRUMemory(RecurrentMemory):
    """A memory of GRU layers (Table 15's GRU-MB)."""

    layer, carried = nn.GRU, ("hidden",)
