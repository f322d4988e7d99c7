"""When a file of less precision stands for float32."""

from __future__ import annotations

import math
from typing import Any

import pytest

from memmlp.runs.deployment_folder import accurate_enough


@pytest.mark.parametrize(
    ("cost", "enough"),
    [
        ({"growth": 0.01, "jitter_growth": 0.10}, True),
        ({"growth": -0.002, "jitter_growth": 0.022}, True),
        ({"growth": 0.011, "jitter_growth": 0.0}, False),
        ({"growth": 0.0016, "jitter_growth": 0.36, "default": True}, False),
        ({"growth": 0.0, "default": True}, False),
        ({"growth": math.nan, "jitter_growth": 0.0}, False),
        ({"growth": 0.0, "jitter_growth": math.nan}, False),
        ({}, False),
    ],
)
def test_unrest_counts_as_error_does(cost: dict[str, Any], enough: bool):
    """A record of before, with default on MPJPE alone, is judged by what it has of Jitter."""
    assert accurate_enough(cost) == enough
