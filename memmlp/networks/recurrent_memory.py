"""Memories of recurrent layers, which replace the paper's memory (Table 15)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.common.components import component
from memmlp.motion.body import SPARSE_DIM
from memmlp.motion.normalizer import in_float32
from memmlp.networks.memory import FeatureMemory, FeatureMemorySettings, Past, Recall, RecurrentPast
from memmlp.networks.motion_model import State
from memmlp.networks.streaming import FrameGRU


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
