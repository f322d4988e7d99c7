"""RecurrentPoser, this project's own network: a recurrent stream of poses, without a window."""

from __future__ import annotations

from collections.abc import Iterator
from typing import cast

import torch
from torch import Tensor, nn

from memmlp.motion.body import HEAD, N_JOINTS, PARENTS, ROTATION, SPARSE_DIM, SPARSE_POSITION
from memmlp.motion.geometry import forward_kinematics, matrix_to_sixd, sixd_to_matrix
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


class RotationHead(nn.Linear):
    """From the hidden state to the motion; the interface of what fills the slot `output`.

    Args:
        normalizer: converts between the world and network space.
        width: d, the width of the hidden state.
    """

    def __init__(self, normalizer: Normalizer, width: int):
        super().__init__(width, ROTATION.stop)

    def posed(self, h: Tensor, sparse: Tensor, normalizer: Normalizer) -> Tensor:
        """Map the hidden state (..., d) to world motion (..., 198) at inputs (..., 54)."""
        raise NotImplementedError


class LocalRotationHead(RotationHead):
    """A head that makes each joint's rotation in its parent's frame."""

    def posed(self, h: Tensor, sparse: Tensor, normalizer: Normalizer) -> Tensor:
        """Map the hidden state (..., d) to world motion (..., 198) at inputs (..., 54)."""
        return normalizer.posed(self(h), sparse)


class GlobalRotationHead(RotationHead):
    """A head that makes each joint's rotation in the frame of the network's space.

    No joint inherits its ancestors' errors, and the positions are sums of turned bones.
    """

    chains: Tensor

    def __init__(self, normalizer: Normalizer, width: int):
        super().__init__(normalizer, width)
        self.register_buffer("chains", chains(), persistent=False)
        with torch.no_grad():  # begin at the mean pose: from a turned one legs don't find home
            self.weight *= 0.3
            self.bias.copy_(mean_pose(normalizer))

    def posed(self, h: Tensor, sparse: Tensor, normalizer: Normalizer) -> Tensor:
        """Map the hidden state (..., d) to world motion (..., 198) at inputs (..., 54)."""
        made = self(h)
        with in_float32(h.device):
            sixd = normalizer.rotations_out(made.to(sparse.dtype), normalizer.origin(sparse))
            rotations = sixd_to_matrix(sixd.unflatten(-1, (N_JOINTS, 6)))
            parents = rotations[..., list(PARENTS[1:]), :, :]
            local = parents.transpose(-1, -2) @ rotations[..., 1:, :, :]
            offsets = normalizer.rest[1:] - normalizer.rest[list(PARENTS[1:])]
            bones = (parents.detach() @ offsets[..., None])[..., 0]
            positions = self.chains @ bones + sparse[..., SPARSE_POSITION][..., None, :3]
            return torch.cat([sixd[..., :6], matrix_to_sixd(local).flatten(-2), positions.flatten(-2)], -1)


def mean_pose(normalizer: Normalizer) -> Tensor:
    """Return the global rotations (132,), 6D, of the mean pose in the network's space."""
    mean = normalizer.mean[SPARSE_DIM:][ROTATION]
    local = sixd_to_matrix(mean.unflatten(-1, (N_JOINTS, 6)))
    return matrix_to_sixd(forward_kinematics(local, mean[:3], normalizer.rest)[0]).flatten()


def chains() -> Tensor:
    """Return the map (22, 21) from bones, of each joint but the root, to the joints seen from the head."""
    made = torch.zeros(N_JOINTS, N_JOINTS - 1)
    for joint in range(1, N_JOINTS):
        made[joint] = made[PARENTS[joint]]
        made[joint, joint - 1] = 1
    return made - made[HEAD]


OUTPUTS: dict[str, type[RotationHead]] = {"local": LocalRotationHead, "global": GlobalRotationHead}
"""The heads by the names that the config knows."""


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
        output: the head, by its name in OUTPUTS.
    """

    def __init__(
        self,
        normalizer: Normalizer,
        *,
        frames: int,
        width: int,
        depth: int,
        cell: str,
        expansion: int,
        output: str,
    ):
        super().__init__(normalizer, frames)
        self.stem = nn.Linear(SPARSE_DIM, width)
        self.blocks = nn.ModuleDict(
            {f"block{i}": RecurrentBlock(CELLS[cell](width), width, expansion) for i in range(1, depth + 1)}
        )
        self.norm = nn.LayerNorm(width)
        self.head = OUTPUTS[output](normalizer, width)

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
        return self.head.posed(self.norm(h), sparse, self.normalizer)

    def advance(self, sparse: Tensor, state: State, newest: int | None = None) -> tuple[Tensor, State]:
        """Take in the newest frames; see MotionModel."""
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
