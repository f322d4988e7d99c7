"""The memory slot: what the backbone sees of the past, and its state for the next call.

A memory makes the backbone's blocks (`make_block`), computes the blocks' view of the past from its buffers
(`recall`), and updates its buffers with the network's output (`remember`). All values are in network space.
This module has the interface and the recurrent memories, which replace the paper's memory (Table 15).
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
from memmlp.motion.normalizer import Normalizer, use_float32
from memmlp.networks.layers import MLPBlock, PlainFusion, ResidualFusion
from memmlp.networks.motion_model import State
from memmlp.networks.streaming import FrameGRU
from memmlp.networks.vqvae import VQVAE


class Past(NamedTuple):
    """The recalled past of the network: the T frames that end one shift before the newest frame.

    Attributes:
        sparse: inputs (B, T, 54).
        motion: the network's motion (B, T, 198).
        codes: code-vectors (B, T, width); width is 0 for a memory without code-vectors.
    """

    sparse: Tensor
    motion: Tensor
    codes: Tensor


class RecurrentPast(NamedTuple):
    """The recalled values of a recurrent memory.

    Attributes:
        features: SiLU of the recurrent layers' outputs in the window (B, blocks, T, k).
        carried: the layers' states after the newest frame, each (B, blocks, k).
    """

    features: Tensor
    carried: State


class MemoryBlock(nn.Module):
    """A block that computes a memory feature from the recalled past, and fuses it with the hidden state.

    Args:
        feature: computes the feature (B, T, k).
        fusion: the MLP block that fuses the feature.
    """

    def __init__(self, feature: nn.Module, fusion: ResidualFusion | PlainFusion):
        super().__init__()
        self.feature = feature
        self.fusion = fusion

    def forward(self, h: Tensor, past: Past | RecurrentPast) -> Tensor:
        """Map the hidden state (B, T, d) to (B, T, d)."""
        return self.fusion.fuse(h, self.feature(past))


class Recall(nn.Module):
    """Computes the contributions of recalled features to the memory blocks at a stream's step.

    Args:
        memory: the network's memory.
        features: the feature modules of the memory blocks.
        parts: the layers that map each block's feature (1, k) to its contribution (1, d).
    """

    def __init__(self, memory: Memory, features: Sequence[Any], parts: Sequence[nn.Module]):
        super().__init__()
        # The memory is asked for windows of one frame: only the frame that enters is new to the stream.
        self.memory = copy.copy(memory)
        self.memory.frames, self.memory.past_frames = 1, memory.past_frames - memory.frames + 1
        self.parts = nn.ModuleList(parts)
        if features:
            self.merge_features(features)

    def merge_features(self, features: Sequence[Any]) -> None:
        """Merge the blocks' feature modules into one module for all blocks."""

    def forward(self, past: Past | RecurrentPast | None) -> tuple[Sequence[Tensor], Sequence[Tensor]]:
        """Return the blocks' contributions (1, d) for the new frame, and for frames before the first."""
        if not self.parts:
            return (), ()
        z = self.compute_features(past)
        before, contributions = self.compute_features_before_start(z), self._compute_contributions(z)
        return contributions, contributions if before is z else self._compute_contributions(before)

    def compute_features(self, past: Any) -> Tensor:
        """Return the features (1, blocks, k) of the new frame."""
        raise NotImplementedError

    def compute_features_before_start(self, first: Tensor) -> Tensor:
        """Return features for the time before the first frame, given its features (1, blocks, k)."""
        return first

    def _compute_contributions(self, z: Tensor) -> Sequence[Tensor]:
        return [part(of) for part, of in zip(self.parts, z.flatten(0, 1).split(1), strict=True)]


FUSIONS: dict[str, type[ResidualFusion | PlainFusion]] = {"residual": ResidualFusion, "plain": PlainFusion}


class Memory(nn.Module):
    """The memory slot's interface; this base class has no state and recalls nothing.

    Args:
        hidden: the backbone's d.
        frames: the backbone's T.
        depth: the backbone's L; not used here.
        codes: the frozen VQ-VAE; not used here.

    Attributes:
        shift: number of frames from the end of the recalled past to the newest frame; 0 without a past. A
            training step advances by the same number of frames.
        past_frames: number of past input frames in the buffer, which ends just before the new frames.
        frames: T, the window's length.
        settled: whether a frame's recalled values never change, so that a stream may compute them once. A
            custom memory must set it to be exported as a streaming graph.
        frames_per_call: maximum number of new frames that can be computed at once, each with its own window.
            A memory with its own `recall` or `remember` has 1 by default.
        streaming_recall: the class that computes the blocks' contributions in a streaming graph.
    """

    streaming_recall: ClassVar[type[Recall]] = Recall

    settled: bool = False
    frames_per_call: int = 1

    def __init_subclass__(cls, **arguments: Any):
        super().__init_subclass__(**arguments)
        if {"recall", "remember"} & vars(cls).keys():
            cls.frames_per_call = vars(cls).get("frames_per_call", 1)

    def __init__(self, *, hidden: int, frames: int, depth: int, codes: VQVAE | None = None):
        super().__init__()
        self.hidden, self.frames = hidden, frames
        self.shift, self.past_frames = 0, frames - 1

    def make_block(self, layer: int) -> nn.Module:
        """Make the backbone's block for a layer (1-based); by default a block without memory."""
        return MLPBlock(self.hidden, self.frames)

    def make_memory_block(self) -> nn.Module:
        """Make a memory block for the predictor's branches (Table 8)."""
        raise InputError("memory: must have memory blocks, since the predictor uses them")

    def count_past(self, new: int) -> int:
        """Return how many past frames a call with this many new frames depends on."""
        return self.past_frames

    def initial_state(self, batch: int) -> State:
        """Return the memory's initial state, zeros."""
        return {}

    def true_state(self, sparse: Tensor, motion: Tensor) -> State:
        """Return the state after the newest past input (B, 54), with true past motion (B, past, 198)."""
        return {}

    def count_needed(self, new: int) -> int:
        """Return the number of newest output frames that `remember` needs."""
        return 0

    def recall(self, sparse: Tensor, state: State, new: int) -> Past | RecurrentPast | None:
        """Return the past for the memory blocks.

        Args:
            sparse: inputs (B, past + new, 54) in network space.
            state: the state from the last call, or `initial_state`.
            new: number of new frames; they are the last frames of `sparse`.
        """
        return None

    def remember(self, motion: Tensor, past: Past | RecurrentPast | None, state: State, new: int) -> State:
        """Return the state after an output.

        Args:
            motion: output (B, n, 198), n at least `count_needed(new)`.
            past: the result of `recall`.
            state: the state before the new frames.
            new: number of new frames; they are the last frames of `motion`.
        """
        return {}

    def auxiliary_losses(self, frames: Tensor, normalizer: Normalizer) -> dict[str, Tensor]:
        """Return the memory's own losses on true world frames (B, T, 252); they add to the network's."""
        return {}


@component("memory", "none")
class NoMemory(Memory):
    """The empty memory: plain blocks, no past, no state."""

    settled = True
    frames_per_call = 256


@dataclass
class FeatureMemorySettings(Settings):
    """The keys of memories that provide a feature for some blocks."""

    # backbone blocks that have a memory layer; default: the even blocks (Sec. 4.1)
    layers: list[int] = setting(each(at_least(1)), "${even_layers:${model.depth}}")
    # k, the width of the memory feature and the hidden size of a recurrent memory (docs/readings.md, no. 3)
    width: int = setting(at_least(1), tiny=8, small=48, paper=192, width_fraction=0.375)
    # residual: x + f([x; z]); plain: Linear([block(x); z]), as in Sec. 4.1 (docs/readings.md, no. 3)
    fusion: str = setting(one_of("residual", "plain"), "residual", literal="plain")


class FeatureMemory(Memory):
    """A memory that provides a feature for some blocks.

    Args:
        settings: the memory's keys; this class uses `layers`, `width` and `fusion`.
        depth: the backbone's L.
        sizes: the other arguments of Memory.

    Raises:
        InputError: if the backbone does not have a layer.
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
        """Make the module that computes a block's memory feature from the recalled past."""
        raise NotImplementedError


class Recurrence(nn.Module):
    """LayerNorm of the sparse features, a recurrent layer, SiLU (App. A; docs/readings.md, no. 19).

    Args:
        kind: the class of the recurrent layer, nn.LSTM or nn.GRU.
        width: k, the layer's hidden size.
    """

    def __init__(self, kind: type[nn.LSTM] | type[nn.GRU], width: int):
        super().__init__()
        self.norm = nn.LayerNorm(SPARSE_DIM)
        self.first = nn.Linear(SPARSE_DIM, width)
        self.layer: nn.Module = kind(SPARSE_DIM, width, batch_first=True)

    def project_first_state(self, sparse: Tensor) -> Tensor:
        """Map the input (B, 54) just before a training window to the initial hidden state (B, k)."""
        return self.first(self.norm(sparse))

    def forward(self, sparse: Tensor, carried: Sequence[Tensor]) -> tuple[Tensor, Sequence[Tensor]]:
        """Run over the inputs (B, n, 54) from the carried states, each (B, k), the hidden state first.

        Returns:
            Features (B, n, k), and the states after the last input.
        """
        states = tuple(state.contiguous()[None] for state in carried)
        single = len(states) == 1  # a GRU, which takes and returns its one state as a tensor
        with use_float32(sparse.device):  # not every CPU has an LSTM in bfloat16
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
    """The `Recall` of recurrent memories. Features before the first frame are zeros."""

    def merge_features(self, features: Sequence[Any]) -> None:
        """Store the index of each block's recurrent layer, and replace GRUs by plain layers."""
        self.layers = [feature.index for feature in features]
        assert isinstance(self.memory, RecurrentMemory)
        for recurrence in self.memory.recurrences:
            if isinstance(recurrence.layer, nn.GRU):
                recurrence.layer = FrameGRU(recurrence.layer)

    def compute_features(self, past: RecurrentPast) -> Tensor:
        newest = past.features[:, :, -1]
        return newest.index_select(1, torch.tensor(self.layers, device=newest.device))

    def compute_features_before_start(self, first: Tensor) -> Tensor:
        """Return zeros, since the layers have seen nothing before the first frame."""
        return torch.zeros_like(first)


class RecurrentMemory(FeatureMemory):
    """A recurrent layer for each memory block, instead of the paper's memory (Table 15).

    A layer runs once over each frame. Its states and its outputs for the window's older frames are carried,
    so a stream gives the same result for any step size. A training step processes a whole window. With
    teacher forcing the hidden state is a projection of the last input before the window, and the cell is zero
    (`true_state`). Otherwise, and in evaluation, the states are carried from call to call, initially zeros.
    See docs/readings.md, no. 19.

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
        """Add a recurrent layer, and make the module that looks up the layer's output."""
        self.recurrences.append(Recurrence(self.layer, self.width))
        return RecurrentFeature(len(self.recurrences) - 1)

    def initial_state(self, batch: int) -> State:
        """Return zeros: states (B, blocks, k), and features of earlier frames (B, blocks, T - 1, k)."""
        blocks = len(self.recurrences)
        states = {name: torch.zeros(batch, blocks, self.width) for name in self.carried}
        return states | {"features": torch.zeros(batch, blocks, self.frames - 1, self.width)}

    def true_state(self, sparse: Tensor, motion: Tensor) -> State:
        """Return hidden states projected from the newest past input (B, 54), for teacher forcing."""
        hidden = [cast(Recurrence, one).project_first_state(sparse) for one in self.recurrences]
        return {"hidden": torch.stack(hidden, 1).float()}

    def recall(self, sparse: Tensor, state: State, new: int) -> RecurrentPast:
        """Run the recurrent layers over the new frames; see Memory.

        The result has the features of the last T frames, and the layers' states after the newest frame.
        """
        features, states = [], []
        for index, recurrence in enumerate(self.recurrences):
            outputs, after = recurrence(sparse[:, -new:], [state[name][:, index] for name in self.carried])
            features.append(outputs)
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
    """An LSTM for each memory block (Table 15): LayerNorm of the sparse features, LSTM, SiLU.

    Teacher forcing projects its initial state from the input before the window. Evaluation carries the
    states. See docs/readings.md, no. 19.
    """


@component("memory", "gru", builds="GRUMemory")
@dataclass
class GRUMemorySettings(LSTMMemorySettings):
    """A GRU for each memory block (Table 15), instead of the LSTM of memory=lstm."""


class LSTMMemory(RecurrentMemory):
    """A memory of LSTM layers (Table 15's LSTM-MB)."""

    layer, carried = nn.LSTM, ("hidden", "cell")


class GRUMemory(RecurrentMemory):
    """A memory of GRU layers (Table 15's GRU-MB)."""

    layer, carried = nn.GRU, ("hidden",)
