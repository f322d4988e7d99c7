"""What less precision costs, as the evaluation measures it."""

from __future__ import annotations

from pathlib import Path

import exported
import numpy as np
import pytest
import tiny

from memmlp.deploy.half_precision import halve
from memmlp.deploy.precision_cost import accuracy, compared
from memmlp.evaluation import modes as evaluation
from memmlp.networks.streaming import streaming

pytestmark = pytest.mark.slow

CLIPS = [tiny.clip(60, seed=seed) for seed in range(3)]


@pytest.fixture(scope="module")
def pair(step_files, tmp_path_factory) -> tuple[Path, Path]:
    """The first tiny network's stream in float32 and in fp16."""
    exact, half = step_files("mem_mlp"), tmp_path_factory.mktemp("pair") / "half.onnx"
    halve(exact, half, streaming(exported.NETWORKS["mem_mlp"]()).float32_modules)
    return exact, half


def test_less_precision_may_stand_for_float32_only_if_it_is_as_good(pair, step_files):
    normalizer = exported.NETWORKS["mem_mlp"]().normalizer
    exact, half = pair
    cost = compared(exact, half, "fp16", normalizer, CLIPS)
    for name, growth in (("MPJPE", "growth"), ("Jitter", "jitter_growth")):
        assert cost[growth] == pytest.approx(cost["fp16"][name] / cost["fp32"][name] - 1)
    assert cost["default"] == (cost["growth"] <= 0.01)
    other = step_files("refined")  # of two networks the better one may stand for the other alone
    both = [compared(*files, "fp16", normalizer, CLIPS) for files in ((exact, other), (other, exact))]
    assert sorted(cost["default"] for cost in both) == [False, True]
    assert (1 + both[0]["growth"]) * (1 + both[1]["growth"]) == pytest.approx(1)
    assert compared(exact, exact, "fp16", normalizer, CLIPS)["default"]


def test_accuracy_is_that_of_the_evaluation(pair):
    model = exported.NETWORKS["mem_mlp"]()
    found = accuracy(pair[0], model.normalizer, CLIPS)
    motions = evaluation.stream(model, CLIPS)
    rows = [
        evaluation.rotations_report(model.normalizer, motion, clip)
        for motion, clip in zip(motions, CLIPS, strict=True)
    ]
    for name, value in found.items():
        assert value == pytest.approx(np.mean([row[name] for row in rows]), rel=1e-3), name
