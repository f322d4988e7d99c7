"""MLP blocks of streaming graphs, on windows without a batch axis."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.networks.layers import MLPBlock, PlainFusion, ResidualFusion
from memmlp.networks.memory import MemoryBlock
from memmlp.networks.predictor_slot import Branch
from memmlp.networks.recurrent_cells import gru_step

Selection = Callable[[Tensor], Tensor]


def newest(window: Tensor) -> Tensor:
    """Return the newest frame (1, size) of a window (T, size)."""
    return window[-1:]


def whole(window: Tensor) -> Tensor:
    """Return a window as it is."""
    return window


class StreamingBlock(nn.Module):
    """An MLP block of a streaming graph.

    Args:
        block: the network's block.
    """

    def __init__(self, block: MLPBlock):
        super().__init__()
        self.time_norm, self.time_mix = block.time_norm, block.time_mix
        self.norm, self.linear = block.norm, block.linear

    def forward(self, h: Tensor, contributions: Sequence[Tensor], take: Selection = whole) -> Tensor:
        """Map (T, d) to what `take` selects of the block's output, without computing the rest.

        Args:
            h: the hidden state (T, d).
            contributions: what each memory block's feature adds to the output of its linear layer, a window
                (T, d) each.
            take: `whole` or `newest`.
        """
        mix = self.time_mix
        h = take(h) + F.silu(torch.addmm(take(mix.bias), take(mix.weight), self.time_norm(h)))
        return self.channels(h, contributions, take)

    def channels(self, h: Tensor, contributions: Sequence[Tensor], take: Selection) -> Tensor:
        """Apply the block's second half, which works frame by frame."""
        return h + F.silu(self.linear(self.norm(h)))


class SharedBlock(StreamingBlock):
    """A memory block whose memory feature is multiplied by its part of the linear layer in advance.

    In [h; z] W = h W_h + z W_z, the feature's contribution z W_z is known when a frame enters.

    Args:
        block: the network's block.
        index: the block's index among the memory blocks.

    Attributes:
        feature_part: computes the contribution (1, d) of a feature (1, k), bias included.
    """

    feature_part: nn.Linear

    def __init__(self, block: MLPBlock, index: int):
        super().__init__(block)
        self.index = index
        self.hidden = block.norm.normalized_shape[0]

    def divided(self, layer: nn.Linear) -> nn.Linear:
        """Split a layer on [h; z] into its parts for h and for z.

        Returns:
            The part for h, without bias. The part for z, with the bias, is kept as `feature_part`.
        """
        self.feature_part = part(layer, slice(self.hidden, None), layer.bias)
        return part(layer, slice(0, self.hidden), None)


class ResidualBlock(SharedBlock):
    """The streaming form of ResidualFusion: h + f([h; z])."""

    def __init__(self, block: ResidualFusion, index: int):
        super().__init__(block, index)
        self.linear = self.divided(block.linear)

    def channels(self, h: Tensor, contributions: Sequence[Tensor], take: Selection) -> Tensor:
        """Apply the block's second half, which works frame by frame."""
        return h + F.silu(self.linear(self.norm(h)) + take(contributions[self.index]))


class PlainBlock(SharedBlock):
    """The streaming form of PlainFusion: an MLP block, then Linear([h; z])."""

    def __init__(self, block: PlainFusion, index: int):
        super().__init__(block, index)
        self.merge = self.divided(block.merge)

    def channels(self, h: Tensor, contributions: Sequence[Tensor], take: Selection) -> Tensor:
        """Apply the block's second half and the merging layer, which work frame by frame."""
        return self.merge(super().channels(h, contributions, take)) + take(contributions[self.index])


def part(layer: nn.Linear, inputs: slice, bias: Tensor | None) -> nn.Linear:
    """Make a linear layer that sees some of another layer's inputs, and has the given bias."""
    weight = layer.weight[:, inputs]
    made = nn.Linear(weight.shape[1], weight.shape[0], bias=bias is not None)
    made.weight = nn.Parameter(weight)
    if bias is not None:
        made.bias = nn.Parameter(bias)
    return made


class FrameGRU(nn.Module):
    """GRU layers for one frame, written as plain layers, since not every runtime has a GRU.

    Args:
        gru: the layers, batch first.
    """

    def __init__(self, gru: nn.GRU):
        super().__init__()
        self.gru = gru

    def forward(self, x: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
        """Map an input (B, 1, n) and states (layers, B, d) to the output (B, 1, d) and the new states."""
        h, after = x[:, 0], []
        for weights, state in zip(self.gru.all_weights, hidden.unbind(), strict=True):
            h = gru_step(weights, h, state)
            after.append(h)
        return h[:, None], torch.stack(after)


class StreamedBranch(nn.Module):
    """A predictor's branch whose last block, if any, and linear layer compute the newest frame alone."""

    def __init__(self, blocks: Sequence[StreamingBlock], linear: nn.Linear):
        super().__init__()
        self.blocks, self.linear = nn.ModuleList(blocks), linear

    def forward(self, h: Tensor, contributions: Sequence[Tensor], count: int) -> Tensor:
        """Map the window (T, d) to the newest frame's outputs (1, size); `count` is always 1."""
        if not len(self.blocks):
            return self.linear(newest(h))
        *earlier, last = self.blocks
        for block in earlier:
            h = block(h, contributions)
        return self.linear(last(h, contributions, newest))


class Converter:
    """Turns a network's blocks into streaming ones, one after the other, and collects what they share.

    Attributes:
        features: the feature modules of all memory blocks so far.
        shared: the streaming memory blocks so far.
    """

    def __init__(self) -> None:
        self.features: list[nn.Module] = []
        self.shared: list[SharedBlock] = []

    def block(self, source: nn.Module) -> StreamingBlock:
        """Make the streaming block of an MLPBlock or a MemoryBlock."""
        if isinstance(source, MemoryBlock):
            return self._memory_block(source)
        assert isinstance(source, MLPBlock)
        return StreamingBlock(source)

    def _memory_block(self, source: MemoryBlock) -> StreamingBlock:
        kinds: dict[type[MLPBlock], type[SharedBlock]] = {
            ResidualFusion: ResidualBlock,
            PlainFusion: PlainBlock,
        }
        self.features.append(source.feature)
        block = kinds[type(source.fusion)](source.fusion, len(self.shared))
        self.shared.append(block)
        return block

    def branch(self, source: Branch) -> StreamedBranch:
        """Make the streaming form of a predictor's branch."""
        return StreamedBranch([self.block(block) for block in source.blocks], source.linear)
