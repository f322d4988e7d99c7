"""Memory features, which memory blocks compute from the recalled past, and the memory block itself."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from memmlp.common import distributed
from memmlp.motion.body import MOTION_DIM, SPARSE_DIM
from memmlp.networks.layers import PlainFusion, ResidualFusion

State = dict[str, Tensor]


class Past(NamedTuple):
    """What a memory of the network's own past recalls: the T frames that end one shift before the newest.

    Attributes:
        sparse: inputs (B, T, 54).
        motion: the network's motion (B, T, 198).
        codes: code-vectors (B, T, width), of width 0 for a memory without them.
    """

    sparse: Tensor
    motion: Tensor
    codes: Tensor


class Recurred(NamedTuple):
    """What a recurrent memory recalls.

    Attributes:
        features: SiLU of the recurrent layers' outputs in the window (B, blocks, T, k).
        carried: the layers' states after the newest frame, each (B, blocks, k).
    """

    features: Tensor
    carried: State


class Projection(nn.Module):
    """Linear, LayerNorm and SiLU, to the memory's width k (Sec. 3.2.1).

    Args:
        size: number of inputs.
        width: k.
    """

    def __init__(self, size: int, width: int):
        super().__init__()
        self.linear = nn.Linear(size, width)
        self.norm = nn.LayerNorm(width)

    def forward(self, x: Tensor) -> Tensor:
        """Map (B, T, size) to (B, T, k)."""
        return F.silu(self.norm(self.linear(x)))


class Blend(nn.Module):
    """The coefficient m (reading 7), drawn from U[0, 1] per frame and channel in training.

    Args:
        value: m at inference, in [0, 1], or "sampled" to draw it at inference too. An exported ONNX file has
            the mean of such draws instead.
    """

    MEAN = 0.5

    def __init__(self, value: float | str):
        super().__init__()
        self.value = value

    @property
    def sampled(self) -> bool:
        """Whether m is drawn at inference too."""
        return isinstance(self.value, str)

    def forward(self, like: Tensor) -> Tensor | float:
        """Return m: a number, or draws of the shape (B, T, k) of `like`."""
        if self.training or isinstance(self.value, str):
            return distributed.drawn(torch.rand_like, like)
        return self.value


class ProjectedFeature(nn.Module):
    """A memory feature made of projections; the base of the features with and without code-vectors."""


class CodeFeature(ProjectedFeature):
    """The paper's memory feature Z_l = Z_x + m * Z_theta + (1 - m) * Z_E (Sec. 3.2.1).

    Args:
        width: k, the width of the feature.
        code_width: width of a code-vector.
        blend: the coefficient m.
    """

    def __init__(self, width: int, code_width: int, blend: Blend):
        super().__init__()
        self.sparse = Projection(SPARSE_DIM, width)
        self.motion = Projection(MOTION_DIM, width)
        self.codes = Projection(code_width, width)
        self.blend = blend

    def forward(self, past: Past) -> Tensor:
        """Return the memory feature (B, T, k)."""
        motion = self.motion(past.motion)
        m = self.blend(motion)
        return self.sparse(past.sparse) + m * motion + (1 - m) * self.codes(past.codes)


class NoCodesFeature(ProjectedFeature):
    """The memory feature without the VQ-VAE, Z_l = Z_x + m * Z_theta (Table 11).

    Args:
        width: k, the width of the feature.
        blend: the coefficient m.
    """

    def __init__(self, width: int, blend: Blend):
        super().__init__()
        self.sparse = Projection(SPARSE_DIM, width)
        self.motion = Projection(MOTION_DIM, width)
        self.blend = blend

    def forward(self, past: Past) -> Tensor:
        """Return the memory feature (B, T, k)."""
        motion = self.motion(past.motion)
        return self.sparse(past.sparse) + self.blend(motion) * motion


class RecurredFeature(nn.Module):
    """The output of a recurrent memory's layer of the given index."""

    def __init__(self, index: int):
        super().__init__()
        self.index = index

    def forward(self, past: Recurred) -> Tensor:
        """Return the memory feature (B, T, k)."""
        return past.features[:, self.index]


class MemoryBlock(nn.Module):
    """A block that computes a memory feature from the recalled past, and takes that feature in.

    Args:
        feature: computes the feature (B, T, k).
        fusion: the MLP block that takes it in.
    """

    def __init__(self, feature: nn.Module, fusion: ResidualFusion | PlainFusion):
        super().__init__()
        self.feature = feature
        self.fusion = fusion

    def forward(self, h: Tensor, past: Past | Recurred) -> Tensor:
        """Map the hidden state (B, T, d) to (B, T, d)."""
        return self.fusion.fuse(h, self.feature(past))
