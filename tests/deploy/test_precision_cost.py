"""What less precision costs, as the evaluation measures it."""

from __future__ import annotations

from pathlib import Path

import exported
import numpy as np
import onnx
import pytest
import tiny
import torch

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
    growth = {name: cost["fp16"][name] / cost["fp32"][name] - 1 for name in cost["fp32"]}
    assert cost["growth"] == pytest.approx(max(growth["MPJPE"], growth["position MPJPE"]))
    assert cost["jitter_growth"] == pytest.approx(growth["Jitter"])
    assert cost["default"] == (cost["growth"] <= 0.01 and cost["jitter_growth"] <= 0.1)
    other = step_files("rotation_only")  # of two networks the better one may stand for the other alone
    both = [compared(*files, "fp16", normalizer, CLIPS) for files in ((exact, other), (other, exact))]
    assert sorted(cost["default"] for cost in both) == [False, True]
    assert compared(exact, exact, "fp16", normalizer, CLIPS)["default"]


def away(motion: torch.Tensor, clip: torch.Tensor) -> float:
    """The mean distance of the positions in motion (N, 198) from those in a clip (N, 252), cm."""
    apart = (motion[:, 132:] - clip[:, 54 + 132 :]).unflatten(-1, (22, 3))
    return 100 * float(apart.norm(dim=-1).mean())


def test_a_spoiled_position_branch_is_no_default(pair, tmp_path):
    """Its rotations are those of the exact file."""
    graph, normalizer = onnx.load(pair[0]), exported.NETWORKS["mem_mlp"]().normalizer
    for node in graph.graph.node:
        for names in (node.input, node.output):
            names[:] = ["unmoved" if name == "position" else name for name in names]
    graph.graph.initializer.append(onnx.numpy_helper.from_array(np.float32(100), "far"))
    graph.graph.node.append(onnx.helper.make_node("Add", ["unmoved", "far"], ["position"]))
    onnx.save(graph, tmp_path / "spoiled.onnx")
    cost = compared(pair[0], tmp_path / "spoiled.onnx", "int8", normalizer, CLIPS)
    assert cost["int8"]["MPJPE"] == cost["fp32"]["MPJPE"]
    assert cost["growth"] > 0.01
    assert not cost["default"]


def test_a_product_beyond_the_range_of_fp16_is_no_default(pair, tmp_path):
    """The values of a layer grow by 1e6 and shrink again behind it, which float32 does not feel."""
    graph, model = onnx.load(pair[0]), exported.NETWORKS["mem_mlp"]()
    products = {node.input[1]: node for node in graph.graph.node if node.op_type == "Gemm"}
    node = products["model.blocks.0.linear.weight"]
    weights = {name: one for one in graph.graph.initializer if (name := one.name) in node.input}
    for name, one in weights.items():
        one.CopyFrom(onnx.numpy_helper.from_array(onnx.numpy_helper.to_array(one) * np.float32(1e5), name))
    output, node.output[0] = node.output[0], "grown"
    graph.graph.initializer.append(onnx.numpy_helper.from_array(np.float32(1e-5), "less"))
    place = list(graph.graph.node).index(node) + 1
    graph.graph.node.insert(place, onnx.helper.make_node("Mul", ["grown", "less"], [output]))
    onnx.save(graph, tmp_path / "grown.onnx")
    halve(tmp_path / "grown.onnx", tmp_path / "half.onnx", streaming(model).float32_modules)
    exact = compared(pair[0], tmp_path / "grown.onnx", "int8", model.normalizer, CLIPS)
    assert abs(exact["growth"]) < 1e-4
    assert not compared(pair[0], tmp_path / "half.onnx", "fp16", model.normalizer, CLIPS)["default"]
    assert compared(*pair, "fp16", model.normalizer, CLIPS)["default"]


def test_accuracy_is_that_of_the_evaluation(pair):
    model = exported.NETWORKS["mem_mlp"]()
    found = accuracy(pair[0], model.normalizer, CLIPS)
    motions = evaluation.stream(model, CLIPS)
    rows = [
        evaluation.rotations_report(model.normalizer, motion, clip) | {"position MPJPE": away(motion, clip)}
        for motion, clip in zip(motions, CLIPS, strict=True)
    ]
    for name, value in found.items():
        assert value == pytest.approx(np.mean([row[name] for row in rows]), rel=1e-3), name
