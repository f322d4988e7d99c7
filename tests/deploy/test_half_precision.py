"""fp16: the inner layers' products alone, near to float32; inputs, outputs and states stay float32."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import exported
import numpy as np
import onnx
import pytest
import tiny
from onnx import TensorProto, numpy_helper
from onnxruntime import InferenceSession

from memmlp.common.errors import InputError
from memmlp.deploy.export import export
from memmlp.deploy.graph_constants import Constants
from memmlp.deploy.half_precision import halve, halved, rounded
from memmlp.deploy.onnx_stream import OnnxStream
from memmlp.deploy.parity import streamed
from memmlp.deploy.quantization import inner_layers
from memmlp.motion.network_coordinates import Heading
from memmlp.networks.streaming import streaming

pytestmark = pytest.mark.slow

CLIP = tiny.clip(40)


@pytest.mark.parametrize("network", ["mem_mlp", "refined", "avatar_poser", "hmd_poser"])
def test_the_products_of_inner_layers_are_fp16(step_files, tmp_path: Path, network: str):
    source, path = step_files(network), tmp_path / "half.onnx"
    ends = streaming(exported.NETWORKS[network]()).float32_modules
    halve(source, path, ends)
    made, inner = onnx.load(path), set(inner_layers(onnx.load(source), ends))
    onnx.checker.check_model(made, full_check=True)
    kinds = {tensor.name: tensor.data_type for tensor in made.graph.initializer}
    products = [node for node in made.graph.node if node.op_type in ("Gemm", "MatMul")]
    halves = {node.name for node in products if kinds.get(node.input[1]) == TensorProto.FLOAT16}
    assert halves == inner != set()
    ends_of_file = (*made.graph.input, *made.graph.output)
    assert {end.type.tensor_type.elem_type for end in ends_of_file} == {TensorProto.FLOAT}
    assert path.stat().st_size < source.stat().st_size + 200 * len(made.graph.node)
    apart = (streamed(OnnxStream(source), CLIP) - streamed(OnnxStream(path), CLIP)).abs()
    assert 1e-7 < float(apart.mean()) < 1e-3


@pytest.mark.parametrize("network", exported.NETWORKS)
def test_every_layer_between_the_ends_is_an_inner_one(step_files, network: str):
    """By the weights' values, whatever the exporter calls them, and whether it transposes them or not."""
    stream, graph = streaming(exported.NETWORKS[network]()), onnx.load(step_files(network))
    weights = {
        name: weight.detach().numpy()
        for name, weight in stream.named_parameters()
        if name.endswith("weight") and weight.ndim == 2
    }
    ends = [weight for name, weight in weights.items() if name.startswith(stream.float32_modules)]
    inner, constants = set(inner_layers(graph, stream.float32_modules)), Constants(graph.graph)
    left = [
        node.name
        for node in graph.graph.node
        if node.op_type in ("Gemm", "MatMul") and node.name not in inner and node.input[1] in constants
        if _is_of(constants.value(node.input[1]), weights.values())
        and not _is_of(constants.value(node.input[1]), ends)
    ]
    assert left == []


def _is_of(constant: np.ndarray, weights: Iterable[np.ndarray]) -> bool:
    return any(np.array_equal(constant, one) or np.array_equal(constant, one.T) for one in weights)


@pytest.mark.parametrize("size", [1.0, 5000.0])
def test_rounded_is_fp16_s_arithmetic(tmp_path: Path, size: float):
    """Of small products, and of some that sixteen bits do not hold."""
    values = size * np.random.default_rng(0).normal(size=(3, 8)).astype(np.float32)
    weight = np.random.default_rng(1).normal(size=(8, 4)).astype(np.float32) * 10
    node = onnx.helper.make_node("MatMul", ["x", "model.inner.weight"], ["y"], "product")
    ends = [onnx.helper.make_tensor_value_info(*end) for end in (("x", 1, [3, 8]), ("y", 1, [3, 4]))]
    stored = [numpy_helper.from_array(weight, "model.inner.weight")]
    graph = onnx.helper.make_graph([node], "one", [ends[0]], [ends[1]], stored)
    opsets = [onnx.helper.make_opsetid("", 18)]
    made = rounded(halved(onnx.helper.make_model(graph, opset_imports=opsets, ir_version=10), []))
    onnx.checker.check_model(made, full_check=True)
    (found,) = InferenceSession(made.SerializeToString()).run(None, {"x": values})
    halves = values.astype(np.float16).astype(np.float32) @ weight.astype(np.float16).astype(np.float32)
    with np.errstate(over="ignore"):
        expected = halves.astype(np.float16).astype(np.float32)
    np.testing.assert_allclose(found, expected, rtol=1e-3)
    assert np.isinf(found).any() == (size > 1)


def test_states_stay_float32(tmp_path: Path):
    """What a recurrent cell adds up is below the resolution of sixteen bits."""
    graph = streaming(tiny.recurrent_poser(Heading(), cell="lru", width=40))
    export(graph, tmp_path / "step.onnx", "0" * 16)
    halve(tmp_path / "step.onnx", tmp_path / "half.onnx", graph.float32_modules)
    made = onnx.shape_inference.infer_shapes(onnx.load(tmp_path / "half.onnx")).graph
    types = {value.name: value.type.tensor_type.elem_type for value in made.value_info}
    types |= {tensor.name: tensor.data_type for tensor in made.initializer}
    sums = [node for node in made.node if node.op_type in ("Add", "Sub", "LayerNormalization", "Concat")]
    assert len(sums) > 10
    assert TensorProto.FLOAT16 not in {types.get(name) for node in sums for name in node.input}


def test_weights_that_do_not_fit_are_refused(step_files):
    model, ends = onnx.load(step_files("mem_mlp")), streaming(exported.NETWORKS["mem_mlp"]()).float32_modules
    (weight,) = (t for t in model.graph.initializer if t.name == "model.blocks.0.linear.weight")
    values = numpy_helper.to_array(weight).copy()
    values[0, 0] = 1e5
    weight.CopyFrom(numpy_helper.from_array(values.astype(np.float32), weight.name))
    with pytest.raises(InputError, match=r"blocks\.0\.linear\.weight: has weights beyond 65504"):
        halved(model, ends)
