"""RecurrentPoser, this project's own network: a recurrent stream of poses, without a window."""

from __future__ import annotations

from collections.abc import Iterator
from typing import cast

import torch
from torch import Tensor, nn

from memmlp.motion.body import ROTATION, SPARSE_DIM
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.cells import CELLS, Cell
from memmlp.networks.layers import in_float32
from memmlp.networks.memory import State
from memmlp.networks.stream_model import StreamModel


class RecurrentBlock(nn.Module):
    """A recurrent cell over time, then a two-layer MLP over the channels, both pre-norm and residual.

    Args:
        cell: the recurrent cell of d inputs and outputs.
        width: d.
        expansion: the MLP's hidden width, in d.
    """

    def __init__(self, cell: Cell, width: int, expansion: int):
        super().__init__()
        self.cell_norm, self.cell = nn.LayerNorm(width), cell
        self.norm = nn.LayerNorm(width)
        self.mlp = nn.Sequential(
            nn.Linear(width, expansion * width), nn.SiLU(), nn.Linear(expansion * width, width)
        )

    def forward(self, h: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Map a sequence (B, n, d) and the cell's state to (B, n, d) and the state after it."""
        x = self.cell_norm(h)
        with in_float32(h.device):  # a state adds up what bfloat16 rounds
            made, state = self.cell(x.float() if x.dtype == torch.bfloat16 else x, state)
        return self.mixed(h + made), state

    def step(self, h: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
        """Map one frame (B, d) and the cell's state to (B, d) and the state after it."""
        made, state = self.cell.step(self.cell_norm(h), state)
        return self.mixed(h + made), state

    def mixed(self, h: Tensor) -> Tensor:
        """Mix the channels of (..., d)."""
        return h + self.mlp(self.norm(h))


class RecurrentPoser(StreamModel):
    """A linear stem, residual blocks of a recurrent cell and an MLP, and a linear head for the rotations.

    The positions follow from the rotations by forward kinematics, the head on its tracker. What the network
    knows of the past is its cells' state; it sees none of its own outputs. Training unrolls it over T frames
    from a zero state, as a live stream starts.

    Args:
        normalizer: converts between the world and network space.
        frames: T, the frames of a training window.
        width: d, the width of the hidden state.
        depth: number of blocks.
        cell: the recurrent cell, by its name in CELLS.
        expansion: the hidden width of the blocks' MLPs, in d.
    """

    def __init__(
        self, normalizer: Normalizer, *, frames: int, width: int, depth: int, cell: str, expansion: int
    ):
        super().__init__(normalizer, frames)
        self.stem = nn.Linear(SPARSE_DIM, width)
        self.blocks = nn.ModuleDict(
            {f"block{i}": RecurrentBlock(CELLS[cell](width), width, expansion) for i in range(1, depth + 1)}
        )
        self.norm = nn.LayerNorm(width)
        self.head = nn.Linear(width, ROTATION.stop)

    def initial_state(self, batch: int = 1) -> State:
        """Return the state of a fresh start: zeros (B, size) of each block's cell, by the block's name."""
        mean = self.normalizer.mean
        return {name: mean.new_zeros(batch, block.cell.size) for name, block in self.named_blocks()}

    def named_blocks(self) -> Iterator[tuple[str, RecurrentBlock]]:
        """Yield the blocks by their names, in order."""
        return cast(Iterator[tuple[str, RecurrentBlock]], self.blocks.items())

    def encoded(self, sparse: Tensor) -> Tensor:
        """Map world inputs (..., 54) to the hidden state (..., d) that enters the blocks."""
        return self.stem(self.normalizer.encode_sparse(sparse, self.normalizer.origin(sparse)))

    def posed(self, h: Tensor, sparse: Tensor) -> Tensor:
        """Map the hidden state (..., d) after the blocks to world motion (..., 198) at inputs (..., 54)."""
        return self.normalizer.posed(self.head(self.norm(h)), sparse)

    def advance(self, sparse: Tensor, state: State, newest: int | None = None) -> tuple[Tensor, State]:
        """Take in the newest frames; see WindowModel."""
        wanted = sparse.shape[1] if newest is None else newest
        h, kept = self.encoded(sparse), {}
        for name, block in self.named_blocks():
            h, kept[name] = block(h, state[name])
        return self.posed(h[:, -wanted:], sparse[:, -wanted:]), kept

    def step(self, sparse: Tensor, state: State) -> tuple[Tensor, State]:
        """Take in one frame of world inputs (B, 54), as `advance` does, in plain layers.

        Returns:
            World motion (B, 198), and the state after the frame.
        """
        h, kept = self.encoded(sparse), {}
        for name, block in self.named_blocks():
            h, kept[name] = block.step(h, state[name])
        return self.posed(h, sparse), kept
