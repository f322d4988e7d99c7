"""MLP blocks on windows held in a ring, their mixing over time turned to the ring's order."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.networks.layers import MLPBlock, PlainFusion, ResidualFusion, TimeMix
from memmlp.networks.memory import MemoryBlock
from memmlp.networks.predictor import Branch

Take = Callable[[Tensor], Tensor]


class StreamStep(NamedTuple):
    """What blocks need to know of a step beside the hidden state.

    Attributes:
        newest: takes the newest frame (1, size) of a window (T, size).
        mixes: each block's mixing over time in the ring's order, weights (T, T) and biases (T, 1).
        shares: what each memory block's feature adds to its linear layer, a window (T, d) each.
    """

    newest: Take
    mixes: Sequence[tuple[Tensor, Tensor]]
    shares: Sequence[Tensor]


class Mixing(nn.Module):
    """The time mixes of all blocks in a ring's order: frame t stands in slot (newest + 1 + t) mod T.

    Both axes of a weight are repeated once, so that the weight in any turned order is a slice of the result.

    Args:
        mixes: the blocks' time mixes.
    """

    def __init__(self, mixes: Sequence[TimeMix]):
        super().__init__()
        self.frames = len(mixes[0].weight)
        self.weight = nn.Parameter(torch.stack([mix.weight.repeat(2, 2) for mix in mixes]))
        self.bias = nn.Parameter(torch.stack([mix.bias.repeat(2, 1) for mix in mixes]))

    def forward(self, slot: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Return each block's weights (T, T) and biases (T, 1) for the newest frame's slot (1,)."""
        # Slot i holds frame (start + i) mod T: row and column i of the turned weight are that frame's.
        start: Any = (self.frames - 1 - slot).squeeze().item()  # a symbol while it is exported
        torch._check(start >= 0)
        torch._check(start <= self.frames)
        weights = self.weight.narrow(1, start, self.frames).narrow(2, start, self.frames).flatten(0, 1)
        biases = self.bias.narrow(1, start, self.frames).flatten(0, 1)
        return list(zip(weights.split(self.frames), biases.split(self.frames), strict=True))


class Block(nn.Module):
    """An MLP block of a streaming graph.

    Args:
        block: the network's block.
        index: the index of its time mix among those of all blocks.
    """

    def __init__(self, block: MLPBlock, index: int):
        super().__init__()
        self.index = index
        self.time_norm, self.norm, self.linear = block.time_norm, block.norm, block.linear

    def forward(self, h: Tensor, step: StreamStep, take: Take = lambda window: window) -> Tensor:
        """Map (T, d) to what `take` selects of the block's output, without computing the rest."""
        weight, bias = step.mixes[self.index]
        h = take(h) + F.silu(torch.addmm(take(bias), take(weight), self.time_norm(h)))
        return self.channels(h, step, take)

    def channels(self, h: Tensor, step: StreamStep, take: Take) -> Tensor:
        """Apply the block's second half, which works frame by frame."""
        return h + F.silu(self.linear(self.norm(h)))


class SharedBlock(Block):
    """A memory block whose memory feature was multiplied by its part of the linear layer beforehand.

    That product is the feature's share: [h; z] W = h W_h + z W_z, and z W_z is known when a frame enters.

    Args:
        block: the network's block.
        index: the index of its time mix among those of all blocks.
        share: the block's index among the memory blocks.

    Attributes:
        feature_part: computes the share (1, d) of a feature (1, k), bias included.
    """

    feature_part: nn.Linear

    def __init__(self, block: MLPBlock, index: int, share: int):
        super().__init__(block, index)
        self.share = share
        self.hidden = block.norm.normalized_shape[0]

    def own(self, layer: nn.Linear) -> nn.Linear:
        """Split a layer on [h; z] into its parts for h and for z.

        Returns:
            The part that sees h, without bias; that of z, with the bias, is kept as `feature_part`.
        """
        self.feature_part = part(layer, slice(self.hidden, None), layer.bias)
        return part(layer, slice(0, self.hidden), None)


class ResidualBlock(SharedBlock):
    """The streaming form of ResidualFusion: h + f([h; z])."""

    def __init__(self, block: ResidualFusion, index: int, share: int):
        super().__init__(block, index, share)
        self.linear = self.own(block.linear)

    def channels(self, h: Tensor, step: StreamStep, take: Take) -> Tensor:
        """Apply the block's second half, which works frame by frame."""
        return h + F.silu(self.linear(self.norm(h)) + take(step.shares[self.share]))


class PlainBlock(SharedBlock):
    """The streaming form of PlainFusion: an MLP block, then Linear([h; z])."""

    def __init__(self, block: PlainFusion, index: int, share: int):
        super().__init__(block, index, share)
        self.merge = self.own(block.merge)

    def channels(self, h: Tensor, step: StreamStep, take: Take) -> Tensor:
        """Apply the block's second half and the merging layer, which work frame by frame."""
        return self.merge(super().channels(h, step, take)) + take(step.shares[self.share])


def part(layer: nn.Linear, inputs: slice, bias: Tensor | None) -> nn.Linear:
    """Make a linear layer that sees some of another layer's inputs, and has the given bias."""
    weight = layer.weight[:, inputs]
    made = nn.Linear(weight.shape[1], weight.shape[0], bias=bias is not None)
    made.weight = nn.Parameter(weight)
    if bias is not None:
        made.bias = nn.Parameter(bias)
    return made


class StreamedBranch(nn.Module):
    """A predictor's branch whose last block and linear layer compute the newest frame alone."""

    def __init__(self, blocks: Sequence[Block], linear: nn.Linear):
        super().__init__()
        self.blocks, self.linear = nn.ModuleList(blocks), linear

    def forward(self, h: Tensor, step: StreamStep, newest: int) -> Tensor:
        """Map the window (T, d) to the newest frame's outputs (1, size); `newest` is always 1."""
        *earlier, last = self.blocks
        for block in earlier:
            h = block(h, step)
        return self.linear(last(h, step, step.newest))


class Converter:
    """Turns a network's blocks into streaming ones, one after the other, and gathers what they share.

    Attributes:
        mixes: the time mixes of all blocks so far.
        features: the feature modules of all memory blocks so far.
        shared: the streaming memory blocks so far.
    """

    def __init__(self) -> None:
        self.mixes: list[TimeMix] = []
        self.features: list[nn.Module] = []
        self.shared: list[SharedBlock] = []

    def block(self, source: nn.Module) -> Block:
        """Make the streaming block of an MLPBlock or a MemoryBlock."""
        if isinstance(source, MemoryBlock):
            return self._memory_block(source)
        assert isinstance(source, MLPBlock)
        self.mixes.append(source.time_mix)
        return Block(source, len(self.mixes) - 1)

    def _memory_block(self, source: MemoryBlock) -> Block:
        kinds: dict[type[MLPBlock], type[SharedBlock]] = {
            ResidualFusion: ResidualBlock,
            PlainFusion: PlainBlock,
        }
        self.mixes.append(source.fusion.time_mix)
        self.features.append(source.feature)
        block = kinds[type(source.fusion)](source.fusion, len(self.mixes) - 1, len(self.shared))
        self.shared.append(block)
        return block

    def branch(self, source: Branch) -> StreamedBranch:
        """Make the streaming form of a predictor's branch."""
        return StreamedBranch([self.block(block) for block in source.blocks], source.linear)
