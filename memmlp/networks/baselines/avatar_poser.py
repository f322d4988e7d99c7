"""AvatarPoser (Jiang et al., ECCV 2022): a transformer encoder whose feature of the newest frame is read.

Its final step, inverse kinematics of the arms, is not part of the network and is left out here.
"""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor, nn

from memmlp.motion.body import N_JOINTS, SPARSE_DIM
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.baselines.transformer_encoder import EncoderLayer, draw_weights
from memmlp.networks.memory import State
from memmlp.networks.motion_model import MotionModel

ROOT = 6  # components of the root's orientation, the first of the rotations


def head(width: int, size: int) -> nn.Module:
    """Make two linear layers with a ReLU between them, from `width` to `size`."""
    return nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, size))


class OwnWindows(MotionModel):
    """The base of networks that predict every frame from the window that ends with it (`rotations`).

    Both evaluation modes give the same numbers, to rounding.
    """

    def rotations(self, encoded: Tensor) -> Tensor:
        """Map windows (B, T, 54) to their last frames' rotations (B, 132), both in network space."""
        raise NotImplementedError

    def advance(self, sparse: Tensor, state: State, newest: int | None = None) -> tuple[Tensor, State]:
        """Take in the newest frames; see MotionModel.

        By default the n new frames are returned, which are the most that this network can make.
        """
        inputs, kept = self.taken_in(sparse, state)
        wanted = sparse.shape[1] if newest is None else newest
        ends = torch.arange(inputs.shape[1] - wanted, inputs.shape[1], device=inputs.device)
        window = ends[:, None] + torch.arange(1 - self.frames, 1, device=inputs.device)
        encoded = self.normalizer.encode_sparse(inputs, self.normalizer.origin(inputs))
        windows = encoded.index_select(1, window.flatten()).unflatten(1, window.shape)
        rotation = self.rotations(windows.flatten(0, 1)).unflatten(0, (len(inputs), wanted))
        return self.normalizer.posed(rotation, inputs[:, -wanted:]), kept


class AvatarPoser(OwnWindows):
    """An embedding, an encoder, and two heads on the newest frame, for the root's orientation and the rest.

    It has 4,124,804 parameters at the paper's sizes (T = 40, d = 256, 8 heads, 3 layers, feed-forward 2048),
    4.12 M in Table 16. Post-norm, ReLU, dropout 0.1 and the lack of a positional encoding are our readings:
    the paper names none of them, and its parameter count leaves no room for learned positions.

    Args:
        normalizer: converts between the world and network space.
        frames: T, the window's length.
        width: d, the width of the features.
        depth: number of encoder layers.
        heads: number of attention heads; it divides d.
        feedforward: width of the feed-forward's hidden layers.
        dropout: dropout rate in the encoder, while training.

    Attributes:
        inputs: how many features of a frame are embedded.
        rotated: how many joints' rotations are predicted besides the root's.
    """

    inputs: ClassVar[int] = SPARSE_DIM
    rotated: ClassVar[int] = N_JOINTS - 1

    def __init__(
        self,
        normalizer: Normalizer,
        *,
        frames: int,
        width: int,
        depth: int,
        heads: int,
        feedforward: int,
        dropout: float,
    ):
        super().__init__(normalizer, frames)
        self.embedding = nn.Linear(self.inputs, width)
        self.layers = nn.ModuleList(EncoderLayer(width, heads, feedforward, dropout) for _ in range(depth))
        self.orientation = head(width, ROOT)
        self.rotation = head(width, 6 * self.rotated)
        draw_weights(self)

    def rotations(self, encoded: Tensor) -> Tensor:
        """Map windows (B, T, 54) to their last frames' rotations (B, 132), both in network space."""
        return self.encode(self.embedding(encoded))

    def encode(self, h: Tensor) -> Tensor:
        """Map the embeddings of windows (B, T, d) to the rotations (B, 132) of their last frames."""
        for layer in self.layers:
            h = layer(h)
        return self.read(h[:, -1])

    def read(self, newest: Tensor) -> Tensor:
        """Map the newest frame's feature (..., d) to rotations (..., 132)."""
        return torch.cat([self.orientation(newest), self.rotation(newest)], -1)
