"""Memory features: what a memory block makes of what is recalled, and the block that takes it in."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.motion.body import MOTION_DIM, SPARSE_DIM
from memmlp.networks.layers import PlainFusion, ResidualFusion

State = dict[str, Tensor]


class Past(NamedTuple):
    """The T frames that end one shift before the newest: inputs, the network's motion, code-vectors."""

    sparse: Tensor
    motion: Tensor
    codes: Tensor


class Recurred(NamedTuple):
    """SiLU of the recurrent layers' outputs in the window (B, blocks, T, k), and what they carry on."""

    features: Tensor
    carried: State


class Projection(nn.Module):
    """Linear, LayerNorm, SiLU to the memory's width k (Sec. 3.2.1)."""

    def __init__(self, size: int, width: int):
        super().__init__()
        self.linear = nn.Linear(size, width)
        self.norm = nn.LayerNorm(width)

    def forward(self, x: Tensor) -> Tensor:
        """(B, T, size) -> (B, T, k)."""
        return F.silu(self.norm(self.linear(x)))


class Blend(nn.Module):
    """The coefficient m (reading 7): U[0, 1] per frame and channel in training, `value` at inference.

    value: a number in [0, 1], or "sampled" to draw at inference as in training. ONNX has the mean of draws.
    """

    MEAN = 0.5

    def __init__(self, value: float | str):
        super().__init__()
        self.value = value

    @property
    def sampled(self) -> bool:
        """Whether m is drawn at inference."""
        return isinstance(self.value, str)

    def forward(self, like: Tensor) -> Tensor | float:
        """m, broadcastable to (B, T, k)."""
        if self.training or isinstance(self.value, str):
            return torch.rand_like(like)
        return self.value


class ProjectedFeature(nn.Module):
    """A memory feature made of projections."""


class CodeFeature(ProjectedFeature):
    """Z_l = Z_x + m * Z_theta + (1 - m) * Z_E (Sec. 3.2.1)."""

    def __init__(self, width: int, code_width: int, blend: Blend):
        super().__init__()
        self.sparse = Projection(SPARSE_DIM, width)
        self.motion = Projection(MOTION_DIM, width)
        self.codes = Projection(code_width, width)
        self.blend = blend

    def forward(self, past: Past) -> Tensor:
        """The memory feature (B, T, k)."""
        motion = self.motion(past.motion)
        m = self.blend(motion)
        return self.sparse(past.sparse) + m * motion + (1 - m) * self.codes(past.codes)


class NoCodesFeature(ProjectedFeature):
    """Z_l = Z_x + m * Z_theta: Table 11's memory without the VQ-VAE."""

    def __init__(self, width: int, blend: Blend):
        super().__init__()
        self.sparse = Projection(SPARSE_DIM, width)
        self.motion = Projection(MOTION_DIM, width)
        self.blend = blend

    def forward(self, past: Past) -> Tensor:
        """The memory feature (B, T, k)."""
        motion = self.motion(past.motion)
        return self.sparse(past.sparse) + self.blend(motion) * motion


class RecurredFeature(nn.Module):
    """The feature of a memory's recurrent layer of that index."""

    def __init__(self, index: int):
        super().__init__()
        self.index = index

    def forward(self, past: Recurred) -> Tensor:
        """The memory feature (B, T, k)."""
        return past.features[:, self.index]


class MemoryBlock(nn.Module):
    """A block that computes its memory feature from what is recalled of the past and takes it in."""

    def __init__(self, feature: nn.Module, fusion: ResidualFusion | PlainFusion):
        super().__init__()
        self.feature = feature
        self.fusion = fusion

    def forward(self, h: Tensor, past: Past | Recurred) -> Tensor:
        """(B, T, d) -> (B, T, d)."""
        return self.fusion.fuse(h, self.feature(past))
