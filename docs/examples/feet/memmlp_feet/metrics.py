"""A metric: how fast a foot moves that stands in truth."""

from __future__ import annotations

from typing import ClassVar

import torch
from torch import Tensor

from memmlp.common.components import component
from memmlp.common.settings import MetricSettings
from memmlp.motion.body import FPS, JOINTS

FEET = [JOINTS.index("left_foot"), JOINTS.index("right_foot")]
STILL = 0.1  # m/s; a slower foot stands


@component("metric", "FootSkate", builds="foot_skate")
class FootSkateSettings(MetricSettings):
    """metric FootSkate."""

    unit: ClassVar[str] = "cm/s"
    smallest: ClassVar[float] = 0.5


def foot_skate(predicted: Tensor, truth: Tensor) -> Tensor:
    """Return the mean speed, cm/s, of feet that stand in truth, for positions (N, 22, 3); NaN without any."""
    true, made = (FPS * motion[:, FEET].diff(dim=0).norm(dim=-1) for motion in (truth, predicted))
    standing = true < STILL
    return 100 * made[standing].mean() if standing.any() else torch.tensor(float("nan"))
