"""AvatarPoser (Jiang et al., ECCV 2022): a transformer encoder, the newest frame's feature read.

Its final step, inverse kinematics of the arms, is no part of the network and none of this one.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.motion.body import ROTATION, SPARSE_DIM
from memmlp.motion.normalizer import Normalizer
from memmlp.networks.memory import State
from memmlp.networks.window_model import WindowModel

ROOT = 6  # components of the root's orientation, the first of the rotations


class Attention(nn.Module):
    """Multi-head self-attention over the frames of a window (Vaswani et al. 2017, Sec. 3.2)."""

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.heads = heads
        self.query, self.key, self.value = (nn.Linear(width, width) for _ in range(3))
        self.out = nn.Linear(width, width)

    def forward(self, h: Tensor) -> Tensor:
        """(B, T, d) -> (B, T, d)."""
        return self.attend(self.query(h), self.key(h), self.value(h))

    def attend(self, *parts: Tensor) -> Tensor:
        """Queries (B, n, d), keys and values (B, T, d) -> (B, n, d)."""
        query, key, value = (part.unflatten(-1, (self.heads, -1)).transpose(1, 2) for part in parts)
        scores = query @ key.transpose(-1, -2) * query.shape[-1] ** -0.5
        return self.out((scores.softmax(-1) @ value).transpose(1, 2).flatten(-2))


class EncoderLayer(nn.Module):
    """Attention, then a feed-forward of two layers, each added to its input and normalised (post-norm).

    Args:
        feedforward: its hidden width. dropout: of both parts' outputs and of the hidden layer.
    """

    def __init__(self, width: int, heads: int, feedforward: int, dropout: float):
        super().__init__()
        self.attention = Attention(width, heads)
        self.attention_norm = nn.LayerNorm(width)
        self.widen, self.narrow = nn.Linear(width, feedforward), nn.Linear(feedforward, width)
        self.norm = nn.LayerNorm(width)
        self.dropout = nn.Dropout(dropout)

    def forward(self, h: Tensor) -> Tensor:
        """(B, T, d) -> (B, T, d)."""
        return self.finish(h, self.attention(h))

    def finish(self, h: Tensor, attended: Tensor) -> Tensor:
        """What follows the attention, frame by frame."""
        h = self.attention_norm(h + self.dropout(attended))
        wide = self.dropout(F.relu(self.widen(h)))
        return self.norm(h + self.dropout(self.narrow(wide)))


def head(width: int, size: int) -> nn.Module:
    """Two layers to `size` outputs."""
    return nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, size))


class AvatarPoser(WindowModel):
    """Embedding, encoder, and two heads on the newest frame: the root's orientation, the local rotations.

    4,124,804 parameters at the paper's sizes (T = 40, d = 256, 8 heads, 3 layers, feed-forward 2048), 4.12 M
    in Table 16. Post-norm, ReLU, dropout 0.1 and no code of a frame's place in the window are readings: the
    paper names none of them, and its count leaves no room for learned places.

    Every frame is made from its own window, so both evaluation modes give the same numbers but for the
    shifted tail window, before which the buffer does not hold the frames of its overlap.

    Args:
        normalizer: world <-> network space.
        frames: T. width: d. depth: layers. heads: of attention; they divide d.
        feedforward: hidden width of the feed-forward layers. dropout: in the encoder, while training.
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
        """Windows of inputs (B, T, 54) -> rotations (B, 132) of their last frames, both in network space."""
        h = self.embedding(encoded)
        for layer in self.layers:
            h = layer(h)
        return self.read(h[:, -1])

    def read(self, newest: Tensor) -> Tensor:
        """The newest frame's feature (..., d) -> rotations (..., 132)."""
        return torch.cat([self.orientation(newest), self.rotation(newest)], -1)

    def advance(self, sparse: Tensor, state: State, newest: int | None = None) -> tuple[Tensor, State]:
        """See WindowModel; by default the n new frames, which are the most that it can make."""
        inputs, kept = self.taken_in(sparse, state)
        wanted = sparse.shape[1] if newest is None else newest
        ends = torch.arange(inputs.shape[1] - wanted, inputs.shape[1], device=inputs.device)
        window = ends[:, None] + torch.arange(1 - self.frames, 1, device=inputs.device)
        encoded = self.normalizer.encode_sparse(inputs, self.normalizer.origin(inputs))[:, window]
        rotation = self.rotations(encoded.flatten(0, 1)).unflatten(0, (len(inputs), wanted))
        return self.normalizer.posed(rotation, inputs[:, -wanted:]), kept
