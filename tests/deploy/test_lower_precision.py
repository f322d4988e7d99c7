"""Lower precisions: which layers have them, what they compute, and what they cost."""

import shutil
from collections.abc import Iterable
from pathlib import Path
from types import SimpleNamespace

import exported
import numpy as np
import onnx
import pytest
import tiny
from conftest import long_except
from onnx import TensorProto, numpy_helper

from memmlp.common.errors import InputError
from memmlp.deploy import lower_precision
from memmlp.deploy.lower_precision import find_inner_layers, write_lower_precision
from memmlp.deploy.onnx_stream import OnnxStream, start_session
from memmlp.deploy.opsets import GraphConstants
from memmlp.deploy.parity import stream_onnx
from memmlp.evaluation import modes as evaluation
from memmlp.networks.streaming import make_streaming_graph

pytestmark = pytest.mark.slow

CLIP = tiny.clip(40)
CLIPS = [tiny.clip(60, seed=seed) for seed in range(3)]


@pytest.mark.parametrize("network", ["mem_mlp", *long_except([], ["refined", "avatar_poser", "sage"])])
def test_every_layer_between_the_ends_is_an_inner_one(step_files, network: str):
    """By the weights' values, whatever the exporter calls them, and whether it transposes them or not."""
    stream, graph = make_streaming_graph(exported.NETWORKS[network]()), onnx.load(step_files(network))
    named = [(name, weight) for name, weight in stream.named_parameters() if name.endswith("weight")]
    weights = {name: weight.detach().numpy() for name, weight in named if weight.ndim == 2}
    ends = [weight for name, weight in weights.items() if name.startswith(stream.float32_modules)]
    inner, constants = set(find_inner_layers(graph, stream.float32_modules)), GraphConstants(graph.graph)
    assert inner
    for node in graph.graph.node:
        if node.op_type in ("Gemm", "MatMul") and node.input[1] in constants:
            value = constants.get_value(node.input[1])
            is_inner = _is_of(value, weights.values()) and not _is_of(value, ends)
            assert is_inner == (node.name in inner), node.name


def _is_of(constant: np.ndarray, weights: Iterable[np.ndarray]) -> bool:
    return any(np.array_equal(constant, one) or np.array_equal(constant, one.T) for one in weights)


@pytest.mark.parametrize("network", ["mem_mlp", *long_except([], ["refined"])])
def test_the_products_of_inner_layers_are_fp16(step_files, tmp_path: Path, network: str):
    source, path = step_files(network), tmp_path / "half.onnx"
    stream = make_streaming_graph(exported.NETWORKS[network]())
    write_lower_precision("fp16", source, path, stream, [])
    made, inner = onnx.load(path), set(find_inner_layers(onnx.load(source), stream.float32_modules))
    onnx.checker.check_model(made, full_check=True)
    kinds = {tensor.name: tensor.data_type for tensor in made.graph.initializer}
    products = [node for node in made.graph.node if node.op_type in ("Gemm", "MatMul")]
    halves = {node.name for node in products if kinds.get(node.input[1]) == TensorProto.FLOAT16}
    assert halves == inner != set()
    ends_of_file = (*made.graph.input, *made.graph.output)
    assert {end.type.tensor_type.elem_type for end in ends_of_file} == {TensorProto.FLOAT}
    assert path.stat().st_size < source.stat().st_size + 200 * len(made.graph.node)
    apart = (stream_onnx(OnnxStream(source), CLIP) - stream_onnx(OnnxStream(path), CLIP)).abs()
    assert 1e-7 < float(apart.mean()) < 1e-3


def one_product(weight: np.ndarray, bias: np.ndarray, rows: int = 1) -> onnx.ModelProto:
    """A graph of one layer: y = x @ weight.T + bias, x (rows, inputs)."""
    stored = {"model.inner.weight": weight, "model.inner.bias": bias}
    node = onnx.helper.make_node("Gemm", ["x", *stored], ["y"], "product", transB=1)
    value = onnx.helper.make_tensor_value_info
    ends = [value(name, 1, [rows, size]) for name, size in zip("yx", weight.shape, strict=True)]
    tensors = [numpy_helper.from_array(array, name) for name, array in stored.items()]
    graph = onnx.helper.make_graph([node], "one", ends[1:], ends[:1], tensors)
    return onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 18)], ir_version=10)


def test_the_newest_frame_has_sixteen_bits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    draw, source, path = np.random.default_rng(0), tmp_path / "step.onnx", tmp_path / "int8.onnx"
    weight, inputs = draw.integers(-1, 2, (8, 16)).astype(np.float32), draw.normal(size=(50, 3, 16))
    onnx.save(one_product(weight, np.zeros(8, np.float32), rows=3), source)
    samples = SimpleNamespace(
        get_next=iter([*({"x": one} for one in inputs.astype(np.float32)), None]).__next__
    )
    monkeypatch.setattr(lower_precision, "ActivationSamples", lambda *_: samples)
    network = SimpleNamespace(float32_modules=(), int16_modules=("inner",))
    write_lower_precision("int8", source, path, network, [])
    onnx.checker.check_model(onnx.load(path), full_check=True)
    session = start_session(path.read_bytes())
    apart = [
        np.abs(session.run(None, {"x": one})[0] - one @ weight.T).max(1) for one in inputs.astype(np.float32)
    ]
    *older, newest = np.mean(apart, 0)
    assert 0 < newest < min(older) / 50


def test_layers_that_onnx_runtime_skips_are_an_error(step_files, tmp_path: Path, monkeypatch):
    """As versions did with some layers of transformers."""
    monkeypatch.setattr(lower_precision, "quantize_static", lambda one, to, *_, **__: shutil.copy(one, to))
    stream = make_streaming_graph(exported.NETWORKS["mem_mlp"]())
    with pytest.raises(RuntimeError, match="layers in float32"):
        write_lower_precision("int8", step_files("mem_mlp"), tmp_path / "int8.onnx", stream, CLIPS)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("precision", ["int8", "fp16"])
def test_a_network_without_inner_layers_is_refused(tmp_path: Path, precision: str):
    path, stream = tmp_path / "step.onnx", SimpleNamespace(float32_modules=("inner",))
    onnx.save(one_product(np.eye(3, dtype=np.float32), np.ones(3, np.float32)), path)
    with pytest.raises(InputError, match=r"export\.precision"):
        write_lower_precision(precision, path, tmp_path / "lower.onnx", stream, [CLIP])
    assert {file.name for file in tmp_path.iterdir()} == {"step.onnx"}


@pytest.fixture(scope="module")
def pair(step_files, tmp_path_factory) -> tuple[Path, Path]:
    exact, half = step_files("mem_mlp"), tmp_path_factory.mktemp("pair") / "half.onnx"
    write_lower_precision("fp16", exact, half, make_streaming_graph(exported.NETWORKS["mem_mlp"]()), [])
    return exact, half


def test_a_small_share_of_each_clip_has_a_jitter(step_files, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(lower_precision, "TEST_FRAMES", 6)  # two frames of each
    normalizer = exported.NETWORKS["mem_mlp"]().normalizer
    found = lower_precision.measure_accuracy(step_files("mem_mlp"), normalizer, [*CLIPS, tiny.clip(3)])
    assert np.isfinite(list(found.values())).all()


def test_accuracy_is_that_of_the_evaluation(pair):
    model = exported.NETWORKS["mem_mlp"]()
    found = lower_precision.measure_accuracy(pair[0], model.normalizer, CLIPS)
    rows = []
    for motion, clip in zip(evaluation.predict_stream(model, CLIPS), CLIPS, strict=True):
        apart = (motion[:, 132:] - clip[:, 54 + 132 :]).unflatten(-1, (22, 3))  # positions, metres
        row = evaluation.measure_rotation_branch(model.normalizer, motion, clip)
        rows.append(row | {"position MPJPE": 100 * float(apart.norm(dim=-1).mean())})
    for name, value in found.items():
        assert value == pytest.approx(np.mean([row[name] for row in rows]), rel=1e-3), name
