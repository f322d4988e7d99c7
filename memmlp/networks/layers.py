"""The MLP block of the backbone and of the predictor, and the block that takes a memory feature in."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class TimeMix(nn.Module):
    """Mixes the frames of a window by a T x T matrix, the same for every channel (Conv1d T -> T, kernel 1).

    Written as one product from the left: no transposes.
    """

    def __init__(self, frames: int):
        super().__init__()
        self.weight = nn.Parameter(torch.empty(frames, frames))
        self.bias = nn.Parameter(torch.zeros(frames, 1))
        nn.init.uniform_(self.weight, -(frames**-0.5), frames**-0.5)

    def forward(self, h: Tensor, newest: int = 0) -> Tensor:
        """(B, T, d) or (T, d) -> the same, or of the `newest` frames alone."""
        weight, bias = self.weight[-newest:], self.bias[-newest:]
        if h.dim() == 2:
            return torch.addmm(bias, weight, h)
        return torch.baddbmm(bias, weight.expand(len(h), -1, -1), h)  # weight @ h + bias, in one pass


class MLPBlock(nn.Module):
    """AGRoL's pre-norm pair (Sec. 3.2.1, reading 1): mix over time, then over channels, both residual."""

    def __init__(self, hidden: int, frames: int, extra: int = 0):
        super().__init__()
        self.time_norm = nn.LayerNorm(hidden)
        self.time_mix = TimeMix(frames)
        self.norm = nn.LayerNorm(hidden)
        self.linear = nn.Linear(hidden + extra, hidden)

    def forward(self, h: Tensor, past: object = None) -> Tensor:
        """(B, T, d) -> (B, T, d); the past is not looked at."""
        return self.newest(h, h.shape[-2])

    def newest(self, h: Tensor, count: int) -> Tensor:
        """(B, T, d) -> the newest frames (B, count, d) of the same, without the work for the others."""
        h = h[..., -count:, :] + F.silu(self.time_mix(self.time_norm(h), count))
        return h + F.silu(self.linear(self.norm(h)))


class ResidualFusion(MLPBlock):
    """An MLP block whose linear takes the memory feature in: h + f([h; z]) (reading 3)."""

    def __init__(self, hidden: int, frames: int, extra: int):
        super().__init__(hidden, frames, extra)

    def fuse(self, h: Tensor, z: Tensor) -> Tensor:
        """Hidden state (B, T, d) and memory feature (B, T, k) -> (B, T, d)."""
        h = h + F.silu(self.time_mix(self.time_norm(h)))
        return h + F.silu(self.linear(torch.cat([self.norm(h), z], -1)))


class PlainFusion(MLPBlock):
    """An MLP block, then Linear([h; z]) from d + k to d without a residual: the literal concatenation."""

    def __init__(self, hidden: int, frames: int, extra: int):
        super().__init__(hidden, frames)
        self.merge = nn.Linear(hidden + extra, hidden)

    def fuse(self, h: Tensor, z: Tensor) -> Tensor:
        """Hidden state (B, T, d) and memory feature (B, T, k) -> (B, T, d)."""
        return self.merge(torch.cat([super().forward(h), z], -1))
