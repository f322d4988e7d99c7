"""The MLP block of the backbone and the predictor, and its two forms that take in a memory feature."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class TimeMix(nn.Module):
    """Mixes the frames of a window by a T x T matrix, the same for every channel (Conv1d T -> T, kernel 1).

    It is written as one matrix product from the left, which needs no transposes.
    """

    def __init__(self, frames: int):
        super().__init__()
        self.weight = nn.Parameter(torch.empty(frames, frames))
        self.bias = nn.Parameter(torch.zeros(frames, 1))
        nn.init.uniform_(self.weight, -(frames**-0.5), frames**-0.5)

    def forward(self, h: Tensor, newest: int = 0) -> Tensor:
        """Mix the frames of a window.

        Args:
            h: (B, T, d) or (T, d).
            newest: how many of the newest frames to return; 0 for all of them.

        Returns:
            (B, n, d) or (n, d), where n is `newest`, or T if that is 0.
        """
        weight, bias = self.weight[-newest:], self.bias[-newest:]
        if h.dim() == 2:
            return torch.addmm(bias, weight, h)
        return torch.baddbmm(bias, weight.expand(len(h), -1, -1), h)  # weight @ h + bias, in one pass


class MLPBlock(nn.Module):
    """AGRoL's pre-norm pair (Sec. 3.2.1, reading 1): mix over time, then over channels, both residual.

    Args:
        hidden: d, the width of the hidden state.
        frames: T, the window's length.
        extra: width of further inputs of the linear layer.
    """

    def __init__(self, hidden: int, frames: int, extra: int = 0):
        super().__init__()
        self.time_norm = nn.LayerNorm(hidden)
        self.time_mix = TimeMix(frames)
        self.norm = nn.LayerNorm(hidden)
        self.linear = nn.Linear(hidden + extra, hidden)

    def forward(self, h: Tensor, past: object = None) -> Tensor:
        """Map the hidden state (B, T, d) to (B, T, d); `past` is ignored."""
        return self.newest(h, h.shape[-2])

    def newest(self, h: Tensor, count: int) -> Tensor:
        """Map (B, T, d) to the newest `count` frames (B, count, d), without computing the others."""
        h = h[..., -count:, :] + F.silu(self.time_mix(self.time_norm(h), count))
        return h + F.silu(self.linear(self.norm(h)))


class ResidualFusion(MLPBlock):
    """An MLP block whose linear layer takes in the memory feature as well: h + f([h; z]) (reading 3).

    Args:
        hidden: d.
        frames: T.
        extra: k, the width of the memory feature.
    """

    def __init__(self, hidden: int, frames: int, extra: int):
        super().__init__(hidden, frames, extra)

    def fuse(self, h: Tensor, z: Tensor) -> Tensor:
        """Map the hidden state (B, T, d) and the memory feature (B, T, k) to (B, T, d)."""
        h = h + F.silu(self.time_mix(self.time_norm(h)))
        return h + F.silu(self.linear(torch.cat([self.norm(h), z], -1)))


class PlainFusion(MLPBlock):
    """An MLP block followed by Linear([h; z]) from d + k to d without a residual: the literal concatenation.

    Args:
        hidden: d.
        frames: T.
        extra: k, the width of the memory feature.
    """

    def __init__(self, hidden: int, frames: int, extra: int):
        super().__init__(hidden, frames)
        self.merge = nn.Linear(hidden + extra, hidden)

    def fuse(self, h: Tensor, z: Tensor) -> Tensor:
        """Map the hidden state (B, T, d) and the memory feature (B, T, k) to (B, T, d)."""
        return self.merge(torch.cat([super().forward(h), z], -1))
