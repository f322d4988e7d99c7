"""Transformer blocks for several networks."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.networks.layers import Dropout

GAIN = 0.2  # by which the weights at the beginning are smaller than Kaiming's


class Attention(nn.Module):
    """Multi-head self-attention over the frames of a window (Vaswani et al. 2017, Sec. 3.2).

    Windows may lack a batch axis.

    Args:
        width: d, the width of the features.
        heads: number of heads, a divisor of d.
    """

    def __init__(self, width: int, heads: int):
        super().__init__()
        self.heads = heads
        self.query, self.key, self.value = (nn.Linear(width, width) for _ in range(3))
        self.out = nn.Linear(width, width)

    def forward(self, h: Tensor, seen: Tensor | None = None) -> Tensor:
        """Map features (B, n, d) to (B, n, d), with attention to `seen` (B, T, d) or to themselves."""
        seen = h if seen is None else seen
        return self.attend(self.query(h), self.key(seen), self.value(seen))

    def attend(self, *parts: Tensor) -> Tensor:
        """Compute attention from queries (B, n, d), keys (B, T, d) and values (B, T, d), in this order.

        Returns:
            (B, n, d).
        """
        query, key, value = (part.unflatten(-1, (self.heads, -1)).transpose(-3, -2) for part in parts)
        scores = query @ key.transpose(-1, -2) * query.shape[-1] ** -0.5
        return self.out((scores.softmax(-1) @ value).transpose(-3, -2).flatten(-2))


class EncoderLayer(nn.Module):
    """Attention, then a feed-forward of two layers, each added to its input and normalised (post-norm).

    Args:
        width: d, the width of the features.
        heads: number of attention heads.
        feedforward: width of the feed-forward's hidden layer.
        dropout: dropout rate of both parts' outputs and of the hidden layer.
        activation: the activation after the hidden layer.
    """

    def __init__(
        self,
        width: int,
        heads: int,
        feedforward: int,
        dropout: float,
        activation: Callable[[Tensor], Tensor] = F.relu,
    ):
        super().__init__()
        self.attention = Attention(width, heads)
        self.attention_norm = nn.LayerNorm(width)
        self.widen, self.narrow = nn.Linear(width, feedforward), nn.Linear(feedforward, width)
        self.norm = nn.LayerNorm(width)
        self.dropout, self.activation = Dropout(dropout), activation

    def forward(self, h: Tensor) -> Tensor:
        """Map features (B, T, d) or (T, d) to the same shape."""
        return self.finish(h, self.attention(h))

    def finish(self, h: Tensor, attended: Tensor) -> Tensor:
        """Apply the remaining layers to the attention's inputs and outputs (..., d), frame by frame."""
        h = self.attention_norm(h + self.dropout(attended))
        wide = self.dropout(self.activation(self.widen(h)))
        return self.norm(h + self.dropout(self.narrow(wide)))


def make_encoder(settings: Any, depth: int, activation: Callable[[Tensor], Tensor] = F.relu) -> nn.ModuleList:
    """Make `depth` encoder layers with a network's width, heads, feedforward and dropout."""
    sizes = settings.width, settings.heads, settings.feedforward, settings.dropout
    return nn.ModuleList(EncoderLayer(*sizes, activation) for _ in range(depth))


@torch.no_grad()
def initialize_weights(part: nn.Module) -> None:
    """Initialize the weights of linear layers like AvatarPoser's released code.

    They have Kaiming's normal distribution (He et al. 2015, Eq. 10) times 0.2, so that initial outputs are
    small: near the mean pose with z-scores. Biases are 0. The released code keeps torch's initial biases
    instead, and limits weights to 0.2. Queries, keys and values share one matrix in torch's attention. Its
    initial weights have Xavier's uniform distribution (Glorot & Bengio 2010, Eq. 16), like in the released
    code.
    """
    for layer in part.modules():
        if isinstance(layer, nn.Linear):
            nn.init.kaiming_normal_(layer.weight).mul_(GAIN)
            nn.init.zeros_(layer.bias)
    for attention in part.modules():
        if isinstance(attention, Attention):
            layers = (attention.query, attention.key, attention.value)
            together = nn.init.xavier_uniform_(torch.cat([layer.weight for layer in layers]))
            for layer, weight in zip(layers, together.chunk(len(layers)), strict=True):
                layer.weight.copy_(weight)


def encode_newest_frame(layers: list[EncoderLayer], h: Tensor) -> Tensor:
    """Apply encoder layers to features (T, d); the last layer only computes the newest frame (1, d)."""
    *earlier, last = layers
    for layer in earlier:
        h = layer(h)
    return last.finish(h[-1:], last.attention(h[-1:], h))


class DiTBlock(nn.Module):
    """Attention and an MLP, which the diffusion time shifts, scales and gates (Peebles & Xie 2023, adaLN).

    Args:
        width: d, the width of the features.
        heads: number of attention heads, a divisor of d.
        ratio: the width of the MLP's hidden layer, as a multiple of d.
    """

    def __init__(self, width: int, heads: int, ratio: int = 1):
        super().__init__()
        self.attention_norm = nn.LayerNorm(width, eps=1e-6, elementwise_affine=False)
        self.attention = Attention(width, heads)
        self.norm = nn.LayerNorm(width, eps=1e-6, elementwise_affine=False)
        hidden = ratio * width
        self.mlp = nn.Sequential(nn.Linear(width, hidden), nn.GELU("tanh"), nn.Linear(hidden, width))
        self.modulation = nn.Linear(width, 6 * width)

    def forward(self, h: Tensor, time: Tensor) -> Tensor:
        """Map features (B, T, d) to (B, T, d), given the activated embedding (B, d) of the times."""
        return self.compute_newest(h, self.modulation(time)[..., None, :].chunk(6, -1), h.shape[-2])

    def compute_newest(self, h: Tensor, modulation: Sequence[Tensor], count: int) -> Tensor:
        """Map features (..., T, d) to the newest `count` frames' features, without computing older frames.

        Args:
            h: features (..., T, d).
            modulation: shift, scale and gate of attention and MLP, broadcast to the features.
            count: number of newest frames to compute.
        """
        shift, scale, gate, mlp_shift, mlp_scale, mlp_gate = modulation
        seen = self.attention_norm(h) * (1 + scale) + shift
        h = h[..., -count:, :] + gate * self.attention(seen[..., -count:, :], seen)
        return h + mlp_gate * self.mlp(self.norm(h) * (1 + mlp_scale) + mlp_shift)
