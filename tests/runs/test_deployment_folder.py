"""When a file of less precision stands for float32."""

import math

from memmlp.runs.deployment_folder import is_accurate_enough

COSTS = [
    ({"growth": 0.01, "jitter_growth": 0.10}, True), ({"growth": -0.002, "jitter_growth": 0.022}, True),
    ({"growth": 0.011, "jitter_growth": 0.0}, False), ({"growth": 0.0016, "jitter_growth": 0.36}, False),
    ({"growth": 0.0}, False), ({"growth": math.nan, "jitter_growth": 0.0}, False),
    ({"growth": 0.0, "jitter_growth": math.nan}, False), ({}, False),
]  # fmt: skip


def test_jitter_counts_as_error_does():
    assert [(cost, is_accurate_enough(cost)) for cost, _ in COSTS] == COSTS
