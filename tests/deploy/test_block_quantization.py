"""Weights in blocks: what is stored, what is computed of it, and which layers have it."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import onnx
import pytest
import tiny
from hypothesis import given
from hypothesis import strategies as st

from memmlp.deploy.block_quantization import BLOCK, LEVELS, ZERO, blocks, quantise_blocks
from memmlp.deploy.deployment import lower
from memmlp.deploy.export import export
from memmlp.deploy.onnx_stream import OnnxStream
from memmlp.deploy.parity import streamed
from memmlp.motion.network_coordinates import Heading
from memmlp.networks.streaming import streaming

CLIP = tiny.clip(40)


def restored(codes: np.ndarray, scales: np.ndarray, inputs: int) -> np.ndarray:
    whole = (codes.astype(float) - ZERO) * scales[..., None]
    return whole.reshape(len(codes), -1)[:, :inputs]


@pytest.mark.slow
@given(outputs=st.integers(1, 5), inputs=st.integers(1, 80), seed=st.integers(0, 99))
def test_a_weight_comes_back_within_half_a_step_of_its_block(outputs: int, inputs: int, seed: int):
    weight = np.random.default_rng(seed).standard_normal((outputs, inputs)).astype(np.float32)
    codes, scales = blocks(weight)
    assert codes.shape == (outputs, -(-inputs // BLOCK), BLOCK)
    steps = np.repeat(scales, BLOCK, 1)[:, :inputs]
    assert (np.abs(restored(codes, scales, inputs) - weight) <= 0.501 * steps).all()
    assert scales.max() == pytest.approx(np.abs(weight).max() / LEVELS)


def test_a_block_of_zeros_stays_one():
    codes, scales = blocks(np.zeros((2, 40), np.float32))
    assert (codes == ZERO).all()
    assert (scales == 0).all()


@pytest.fixture(scope="module", params=["gru", "lru"])
def files(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return the same stream in float32 and in blocks, by name."""
    folder = tmp_path_factory.mktemp("blocks")
    graph = streaming(tiny.recurrent_poser(Heading(), cell=request.param, width=40))
    export(graph, folder / "exact.onnx", "0" * 16)
    lower("int8_blocks", folder / "exact.onnx", folder / "blocks.onnx", graph, [])
    return {path.stem: path for path in folder.iterdir()}


@pytest.mark.slow
def test_the_cells_are_in_blocks_and_all_else_is_not(files: dict[str, Path]):
    before, after = (Counter(node.op_type for node in onnx.load(files[name]).graph.node) for name in files)
    products = [node for node in onnx.load(files["blocks"]).graph.node if node.op_type == "MatMulNBits"]
    stored = {tensor.name for tensor in onnx.load(files["blocks"]).graph.initializer}
    layers = {node.input[1].removesuffix(".blocks") for node in products}
    assert layers
    assert all(".cell." in name for name in layers)
    assert not layers & stored  # the float32 weights are gone
    member = "model.model.members.member1"
    assert {f"{member}.stem.weight", f"{member}.head.weight"} <= stored
    assert sum(".mlp." in name and name.endswith(".weight") for name in stored) == 4
    assert sum(before.values()) == sum(after.values())


@pytest.mark.slow
def test_the_motion_is_near_and_not_the_same(files: dict[str, Path]):
    exact, other = (streamed(OnnxStream(files[name]), CLIP) for name in ("exact", "blocks"))
    assert 1e-6 < float((exact - other).abs().mean()) < 0.005


@pytest.mark.slow
def test_a_product_is_that_of_the_rounded_weight(tmp_path: Path):
    """Computed independently, with inputs rounded as the operator rounds them: in blocks, to eight bits."""
    rng = np.random.default_rng(0)
    weight, bias = rng.standard_normal((24, 70)).astype(np.float32), np.ones(24, np.float32)
    values = rng.standard_normal((1, 70)).astype(np.float32)
    node = onnx.helper.make_node(
        "Gemm", ["x", "model.inner.weight", "model.inner.bias"], ["y"], "g", transB=1
    )
    graph = onnx.helper.make_graph(
        [node],
        "one",
        [onnx.helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, [1, 70])],
        [onnx.helper.make_tensor_value_info("y", onnx.TensorProto.FLOAT, [1, 24])],
        [onnx.numpy_helper.from_array(weight, "model.inner.weight"),
         onnx.numpy_helper.from_array(bias, "model.inner.bias")],
    )  # fmt: skip
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 18)], ir_version=10)
    onnx.save(model, tmp_path / "exact.onnx")
    quantise_blocks(tmp_path / "exact.onnx", tmp_path / "blocks.onnx", ())
    import onnxruntime

    made = onnxruntime.InferenceSession(tmp_path / "blocks.onnx").run(None, {"x": values})[0]
    rounded = restored(*blocks(values), 70) @ restored(*blocks(weight), 70).T + bias
    np.testing.assert_allclose(made, rounded, atol=2e-3)
    assert np.abs(made - (values @ weight.T + bias)).max() > 2e-3
