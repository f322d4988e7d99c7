"""MLP blocks on windows held as a ring: their mixing over time turned to the ring's order."""

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
    """What blocks need of a step beside the hidden state.

    newest: a window's newest frame. mixes: each block's mixing over time, weights (T, T) and offsets (T, 1),
    in the ring's order. shares: what each memory block's feature adds, windows (T, d).
    """

    newest: Take
    mixes: Sequence[tuple[Tensor, Tensor]]
    shares: Sequence[Tensor]


class Mixing(nn.Module):
    """The time mixes of all blocks, turned to a ring's order: frame t stands in slot (newest + 1 + t) mod T.

    Both axes of a weight are repeated once, so that any turn of it is a piece of that.
    """

    def __init__(self, mixes: Sequence[TimeMix]):
        super().__init__()
        self.frames = len(mixes[0].weight)
        self.weight = nn.Parameter(torch.stack([mix.weight.repeat(2, 2) for mix in mixes]))
        self.bias = nn.Parameter(torch.stack([mix.bias.repeat(2, 1) for mix in mixes]))

    def forward(self, slot: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Weights (T, T) and offsets (T, 1) of each block for the newest frame's slot (1,)."""
        start: Any = (self.frames - 1 - slot).squeeze().item()  # a symbol while it is exported
        torch._check(start >= 0)
        torch._check(start <= self.frames)
        weights = self.weight.narrow(1, start, self.frames).narrow(2, start, self.frames).flatten(0, 1)
        biases = self.bias.narrow(1, start, self.frames).flatten(0, 1)
        return list(zip(weights.split(self.frames), biases.split(self.frames), strict=True))


class Block(nn.Module):
    """An MLP block in a stream.

    Args:
        block: the network's. index: of its time mix among all.
    """

    def __init__(self, block: MLPBlock, index: int):
        super().__init__()
        self.index = index
        self.time_norm, self.norm, self.linear = block.time_norm, block.norm, block.linear

    def forward(self, h: Tensor, step: StreamStep, take: Take = lambda window: window) -> Tensor:
        """(T, d) -> the same, or what `take` leaves of it without the work for the rest."""
        weight, bias = step.mixes[self.index]
        h = take(h) + F.silu(torch.addmm(take(bias), take(weight), self.time_norm(h)))
        return self.channels(h, step, take)

    def channels(self, h: Tensor, step: StreamStep, take: Take) -> Tensor:
        """The block's second half, frame by frame."""
        return h + F.silu(self.linear(self.norm(h)))


class SharedBlock(Block):
    """A memory block, whose memory feature's share in its linear layer was computed before.

    Args:
        block, index: as Block's. share: its index among the memory blocks.

    Attributes:
        feature_part: makes that share (1, d) of a feature (1, k), bias included.
    """

    feature_part: nn.Linear

    def __init__(self, block: MLPBlock, index: int, share: int):
        super().__init__(block, index)
        self.share = share
        self.hidden = block.norm.normalized_shape[0]

    def own(self, layer: nn.Linear) -> nn.Linear:
        """The part of the layer that takes the memory feature in, [h; z] -> d, which sees h; no bias."""
        self.feature_part = part(layer, slice(self.hidden, None), layer.bias)
        return part(layer, slice(0, self.hidden), None)


class ResidualBlock(SharedBlock):
    """ResidualFusion's: h + f([h; z])."""

    def __init__(self, block: ResidualFusion, index: int, share: int):
        super().__init__(block, index, share)
        self.linear = self.own(block.linear)

    def channels(self, h: Tensor, step: StreamStep, take: Take) -> Tensor:
        """The block's second half, frame by frame."""
        return h + F.silu(self.linear(self.norm(h)) + take(step.shares[self.share]))


class PlainBlock(SharedBlock):
    """PlainFusion's: an MLP block, then Linear([h; z])."""

    def __init__(self, block: PlainFusion, index: int, share: int):
        super().__init__(block, index, share)
        self.merge = self.own(block.merge)

    def channels(self, h: Tensor, step: StreamStep, take: Take) -> Tensor:
        """The block's second half and the merging, frame by frame."""
        return self.merge(super().channels(h, step, take)) + take(step.shares[self.share])


def part(layer: nn.Linear, inputs: slice, bias: Tensor | None) -> nn.Linear:
    """A linear layer of some of another's inputs."""
    weight = layer.weight[:, inputs]
    made = nn.Linear(weight.shape[1], weight.shape[0], bias=bias is not None)
    made.weight = nn.Parameter(weight)
    if bias is not None:
        made.bias = nn.Parameter(bias)
    return made


class StreamedBranch(nn.Module):
    """A predictor's branch; its last block and its head make the newest frame alone."""

    def __init__(self, blocks: Sequence[Block], linear: nn.Linear):
        super().__init__()
        self.blocks, self.linear = nn.ModuleList(blocks), linear

    def forward(self, h: Tensor, step: StreamStep, newest: int) -> Tensor:
        """(T, d) -> (1, size)."""
        *earlier, last = self.blocks
        for block in earlier:
            h = block(h, step)
        return self.linear(last(h, step, step.newest))


class Converter:
    """Makes a network's blocks a stream's, one after the other, and gathers what they have in common."""

    def __init__(self) -> None:
        self.mixes: list[TimeMix] = []
        self.features: list[nn.Module] = []
        self.shared: list[SharedBlock] = []

    def block(self, source: nn.Module) -> Block:
        """The stream's block of an MLPBlock or MemoryBlock."""
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
        """The stream's branch."""
        return StreamedBranch([self.block(block) for block in source.blocks], source.linear)
