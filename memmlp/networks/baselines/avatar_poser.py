"""AvatarPoser (Jiang et al., ECCV 2022): a transformer encoder whose feature of the newest frame is read.

Its final step, inverse kinematics of the arms, is not part of the network and is left out here.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.motion.body import ROTATION, SPARSE_DIM
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.layers import Dropout
from memmlp.networks.memory import State
from memmlp.networks.window_model import WindowModel

ROOT = 6  # components of the root's orientation, the first of the rotations


class Attention(nn.Module):
    """Multi-head self-attention over the frames of a window (Vaswani et al. 2017, Sec. 3.2).

    Args:
        width: d, the width of the features.
        heads: number of heads; it divides d.
    """

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.heads = heads
        self.query, self.key, self.value = (nn.Linear(width, width) for _ in range(3))
        self.out = nn.Linear(width, width)

    def forward(self, h: Tensor) -> Tensor:
        """Map features (B, T, d) to (B, T, d)."""
        return self.attend(self.query(h), self.key(h), self.value(h))

    def attend(self, *parts: Tensor) -> Tensor:
        """Attend with queries (B, n, d) to keys (B, T, d) and values (B, T, d), given in this order.

        Returns:
            (B, n, d).
        """
        query, key, value = (part.unflatten(-1, (self.heads, -1)).transpose(1, 2) for part in parts)
        scores = query @ key.transpose(-1, -2) * query.shape[-1] ** -0.5
        return self.out((scores.softmax(-1) @ value).transpose(1, 2).flatten(-2))


class EncoderLayer(nn.Module):
    """Attention, then a feed-forward of two layers, each added to its input and normalised (post-norm).

    Args:
        width: d, the width of the features.
        heads: number of attention heads.
        feedforward: width of the feed-forward's hidden layer.
        dropout: dropout rate of both parts' outputs and of the hidden layer.
    """

    def __init__(self, width: int, heads: int, feedforward: int, dropout: float):
        super().__init__()
        self.attention = Attention(width, heads)
        self.attention_norm = nn.LayerNorm(width)
        self.widen, self.narrow = nn.Linear(width, feedforward), nn.Linear(feedforward, width)
        self.norm = nn.LayerNorm(width)
        self.dropout = Dropout(dropout)

    def forward(self, h: Tensor) -> Tensor:
        """Map features (B, T, d) to (B, T, d)."""
        return self.finish(h, self.attention(h))

    def finish(self, h: Tensor, attended: Tensor) -> Tensor:
        """Apply what follows the attention, frame by frame, to its inputs and outputs (..., d)."""
        h = self.attention_norm(h + self.dropout(attended))
        wide = self.dropout(F.relu(self.widen(h)))
        return self.norm(h + self.dropout(self.narrow(wide)))


def head(width: int, size: int) -> nn.Module:
    """Make two linear layers with a ReLU between them, from `width` to `size`."""
    return nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, size))


class AvatarPoser(WindowModel):
    """An embedding, an encoder, and two heads on the newest frame, for the root's orientation and the rest.

    It has 4,124,804 parameters at the paper's sizes (T = 40, d = 256, 8 heads, 3 layers, feed-forward 2048),
    4.12 M in Table 16. Post-norm, ReLU, dropout 0.1 and the lack of a positional encoding are our readings:
    the paper names none of them, and its parameter count leaves no room for learned positions.

    Every frame is predicted from its own window, so both evaluation modes give the same numbers, except for
    the shifted tail window: there the buffer does not hold the frames of its overlap.

    Args:
        normalizer: converts between the world and network space.
        frames: T, the window's length.
        width: d, the width of the features.
        depth: number of encoder layers.
        heads: number of attention heads; it divides d.
        feedforward: width of the feed-forward's hidden layers.
        dropout: dropout rate in the encoder, while training.
    """

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
        self.embedding = nn.Linear(SPARSE_DIM, width)
        self.layers = nn.ModuleList(EncoderLayer(width, heads, feedforward, dropout) for _ in range(depth))
        self.orientation = head(width, ROOT)
        self.rotation = head(width, ROTATION.stop - ROOT)

    def rotations(self, encoded: Tensor) -> Tensor:
        """Map windows (B, T, 54) to their last frames' rotations (B, 132), both in network space."""
        h = self.embedding(encoded)
        for layer in self.layers:
            h = layer(h)
        return self.read(h[:, -1])

    def read(self, newest: Tensor) -> Tensor:
        """Map the newest frame's feature (..., d) to rotations (..., 132)."""
        return torch.cat([self.orientation(newest), self.rotation(newest)], -1)

    def advance(self, sparse: Tensor, state: State, newest: int | None = None) -> tuple[Tensor, State]:
        """Take in the newest frames; see WindowModel.

        By default the n new frames are returned, which are the most that it can make.
        """
        inputs, kept = self.taken_in(sparse, state)
        wanted = sparse.shape[1] if newest is None else newest
        ends = torch.arange(inputs.shape[1] - wanted, inputs.shape[1], device=inputs.device)
        window = ends[:, None] + torch.arange(1 - self.frames, 1, device=inputs.device)
        encoded = self.normalizer.encode_sparse(inputs, self.normalizer.origin(inputs))[:, window]
        rotation = self.rotations(encoded.flatten(0, 1)).unflatten(0, (len(inputs), wanted))
        return self.normalizer.posed(rotation, inputs[:, -wanted:]), kept
