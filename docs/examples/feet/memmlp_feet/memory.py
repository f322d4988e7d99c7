"""A memory that tells the backbone the mean of the inputs over the window."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torch import Tensor, nn

from memmlp.common.components import component
from memmlp.common.settings import Settings, at_least, each, one_of, setting
from memmlp.motion.body import SPARSE_DIM
from memmlp.networks.memory import FeatureMemory
from memmlp.networks.motion_model import State


class MeanFeature(nn.Module):
    """Projects the mean inputs.

    Args:
        width: k, the width of the feature.
    """

    def __init__(self, width: int):
        super().__init__()
        self.projection = nn.Sequential(nn.Linear(SPARSE_DIM, width), nn.SiLU())

    def forward(self, mean: Tensor) -> Tensor:
        """Map the mean inputs of each frame's past (B, T, 54) to features (B, T, k)."""
        return self.projection(mean)


@component("memory", "mean", builds="MeanMemory")
@dataclass
class MeanMemorySettings(Settings):
    """memory=mean: the mean of the inputs over the window, for each memory block."""

    # which blocks of the backbone have it
    layers: list[int] = setting(each(at_least(1)), "${even_layers:${model.depth}}")
    width: int = setting(at_least(1), tiny=8, small=48, paper=192)  # the width of the feature
    # residual: x + f([x; z]); plain: f([x; z])
    fusion: str = setting(one_of("residual", "plain"), "residual")


class MeanMemory(FeatureMemory):
    """A memory without a state: what a frame recalls is the mean of the inputs up to it.

    Args:
        settings: the memory's keys.
        sizes: the other arguments of FeatureMemory.
    """

    def __init__(self, settings: MeanMemorySettings, **sizes: Any):
        super().__init__(settings, **sizes)
        self.shift, self.past_frames = 0, self.frames - 1

    def make_feature(self) -> nn.Module:
        """Make the module that computes a block's memory feature."""
        return MeanFeature(self.width)

    def recall(self, sparse: Tensor, state: State, new: int) -> Tensor:
        """Return the mean of the window's inputs up to each frame (B, T, 54)."""
        window = sparse[:, -self.frames :]
        counts = window.new_ones(self.frames).cumsum(0)[:, None]
        return window.cumsum(1) / counts
