"""What a memory recalls for one frame, and what therefore enters a stream's windows at a step."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.networks.memory import (
    Memory,
    OwnPastMemory,
    Past,
    ProjectedFeature,
    Projection,
    Recurred,
    RecurrentMemory,
    VQMemory,
)
from memmlp.networks.streaming.blocks import FrameGRU, SharedBlock
from memmlp.networks.vqvae import VQVAE

Pieces = Sequence[Tensor]


class ProjectionsAtOnce(nn.Module):
    """The projections that several memory blocks make of the same input, computed at once.

    Args:
        parts: the blocks' projections, all of the same shape.
    """

    def __init__(self, parts: Sequence[Projection]):
        super().__init__()
        self.shape = len(parts), parts[0].norm.normalized_shape[0]
        self.weight = nn.Parameter(torch.cat([part.linear.weight for part in parts]))
        self.bias = nn.Parameter(torch.cat([part.linear.bias for part in parts]))
        self.scale = nn.Parameter(torch.stack([part.norm.weight for part in parts]))
        self.offset = nn.Parameter(torch.stack([part.norm.bias for part in parts]))

    def forward(self, x: Tensor) -> Tensor:
        """Map inputs (n, size) to the projections of all blocks (n, blocks, k)."""
        y = F.linear(x, self.weight, self.bias).view(-1, *self.shape)
        return F.silu(F.layer_norm(y, self.shape[1:]) * self.scale + self.offset)


class CodeTable(nn.Module):
    """The projections of all code-vectors, computed in advance and looked up by index.

    Args:
        parts: the blocks' projections.
        vectors: the code-vectors (K, width).
    """

    def __init__(self, parts: Sequence[Projection], vectors: Tensor):
        super().__init__()
        self.projected = nn.Parameter(ProjectionsAtOnce(parts)(vectors).detach())

    def forward(self, index: Tensor) -> Tensor:
        """Map the index (1,) of a code-vector to its projections (1, blocks, k)."""
        return self.projected.index_select(0, index)


class Indices(nn.Module):
    """A stand-in for a VQ-VAE that gives the index of a frame's code-vector instead of the vector."""

    def __init__(self, codes: VQVAE):
        super().__init__()
        self.encoder, self.codebook = codes.encoder, codes.codebook

    def code_vectors(self, sparse: Tensor, motion: Tensor) -> Tensor:
        """Return the index (1, 1) for a frame's inputs (1, 1, 54) and motion (1, 1, 198)."""
        return self.codebook.indices(self.encoder(torch.cat([sparse[0], motion[0]], -1)))[None]


class Recall(nn.Module):
    """Computes, for each memory block, what the recalled feature adds to it at this step.

    Args:
        memory: the network's memory.
        features: the feature modules of its memory blocks.
        blocks: the streaming memory blocks.
    """

    def __init__(self, memory: Memory, features: Sequence[Any], blocks: Sequence[SharedBlock]):
        super().__init__()
        # The memory is asked for windows of one frame: only the frame that enters is new to the stream.
        self.memory = copy.copy(memory)
        self.memory.frames, self.memory.past_frames = 1, memory.past_frames - memory.frames + 1
        self.parts = nn.ModuleList(block.feature_part for block in blocks)
        if features:
            self.gather(features)

    def gather(self, features: Sequence[Any]) -> None:
        """Join the blocks' feature modules into one that computes a frame's features for all of them."""

    def forward(self, past: Past | Recurred | None) -> tuple[Pieces, Pieces]:
        """Return each block's contribution (1, d): of the entering frame, and of frames before the first."""
        if not self.parts:
            return (), ()
        z = self.feature(past)
        contributions = self._contributions(z)
        before = self.before(z)
        return contributions, contributions if before is z else self._contributions(before)

    def feature(self, past: Any) -> Tensor:
        """Return the features (1, blocks, k) of the frame that enters."""
        raise NotImplementedError

    def before(self, first: Tensor) -> Tensor:
        """Return the features of frames before the first one, given the first one's (1, blocks, k)."""
        return first

    def _contributions(self, z: Tensor) -> Pieces:
        return [part(of) for part, of in zip(self.parts, z.flatten(0, 1).split(1), strict=True)]


class OwnPast(Recall):
    """Recall for memories that project the inputs and the network's own motion."""

    def gather(self, features: Sequence[ProjectedFeature]) -> None:
        """Make one feature module whose projections are those of all blocks."""
        self.whole = copy.deepcopy(features[0])
        for name, child in list(self.whole.named_children()):
            if isinstance(child, Projection):
                setattr(self.whole, name, self.projections(name, [getattr(f, name) for f in features]))

    def projections(self, name: str, parts: Sequence[Projection]) -> nn.Module:
        """Join all blocks' projections of the input with the given name: "sparse", "motion" or "codes"."""
        return ProjectionsAtOnce(parts)

    def feature(self, past: Past) -> Tensor:
        """Return the features (1, blocks, k) of the frame that enters."""
        return self.whole(Past(*(part[0] for part in past)))


class Coded(OwnPast):
    """Recall for memories that have code-vectors as well, whose projections are looked up."""

    def gather(self, features: Sequence[ProjectedFeature]) -> None:
        """Make one feature module whose projections are those of all blocks."""
        assert isinstance(self.memory, VQMemory)
        self.vectors = self.memory.codes.codebook.vectors
        super().gather(features)
        # In a new dict, since the shallow copy of the memory shares its own with the network's.
        self.memory._modules = {**self.memory._modules, "codes": Indices(self.memory.codes)}

    def projections(self, name: str, parts: Sequence[Projection]) -> nn.Module:
        """Join all blocks' projections of the input with the given name; code-vectors get a table."""
        return CodeTable(parts, self.vectors) if name == "codes" else super().projections(name, parts)


class FromRecurrence(Recall):
    """Recall for recurrent memories, whose features before the first frame are zeros."""

    def gather(self, features: Sequence[Any]) -> None:
        """Note the index of each block's recurrent layer, and replace GRUs by plain layers."""
        self.layers = [feature.index for feature in features]
        assert isinstance(self.memory, RecurrentMemory)
        for recurrence in self.memory.recurrences:
            if isinstance(recurrence.layer, nn.GRU):
                recurrence.layer = FrameGRU(recurrence.layer)

    def feature(self, past: Recurred) -> Tensor:
        """Return the features (1, blocks, k) of the frame that enters."""
        newest = past.features[:, :, -1]
        return newest.index_select(1, torch.tensor(self.layers, device=newest.device))

    def before(self, first: Tensor) -> Tensor:
        """Return zeros, since the layers have seen nothing before the first frame."""
        return torch.zeros_like(first)


def recall(memory: Memory, features: Sequence[nn.Module], blocks: Sequence[SharedBlock]) -> Recall:
    """Choose the kind of Recall that fits the memory."""
    ways: dict[type[Memory], type[Recall]] = {
        VQMemory: Coded,
        OwnPastMemory: OwnPast,
        RecurrentMemory: FromRecurrence,
        Memory: Recall,
    }
    way = next(way for kind, way in ways.items() if isinstance(memory, kind))
    return way(memory, features, blocks)
