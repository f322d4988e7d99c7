"""A step in every opset: checked, the same numbers, and no operator whose work depends on the data."""

from pathlib import Path

import exported
import numpy as np
import onnx
import pytest
import tiny
from conftest import long_except
from onnx import ModelProto, TensorProto, helper, numpy_helper

from memmlp.common.errors import InputError
from memmlp.config.schema import ExportConfig
from memmlp.deploy.onnx_stream import OnnxStream
from memmlp.deploy.opsets import NATIVE, OPSETS, convert_opset
from memmlp.deploy.parity import TOLERANCE, stream_onnx

CLIP = tiny.clip(20)


def model(*nodes: onnx.NodeProto, **constants: np.ndarray) -> ModelProto:
    value = helper.make_tensor_value_info
    ends = value("x", TensorProto.FLOAT, [2, 4]), value("y", TensorProto.FLOAT, ["rows", "columns"])
    initializers = [numpy_helper.from_array(array, name) for name, array in constants.items()]
    graph = helper.make_graph(nodes, "graph", ends[:1], ends[1:], initializers)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", NATIVE)], ir_version=10)


@pytest.mark.slow
@pytest.mark.parametrize("network", ["mem_mlp", "avatar_poser", *long_except([], ["lstm", "bodiffusion"])])
def test_a_step_computes_the_same_in_every_opset(step_files, tmp_path: Path, network: str):
    source, path = step_files(network), tmp_path / "step.onnx"
    native = onnx.load(source)
    assert exported.data_dependent(native.graph) == set()
    expected = stream_onnx(OnnxStream(source), CLIP)
    for opset in OPSETS if network == "mem_mlp" else (15, OPSETS[-1]):
        made = convert_opset(native, opset)
        onnx.checker.check_model(made, full_check=True)
        assert [(one.domain, one.version) for one in made.opset_import] == [("", opset)]
        assert [p.value for p in made.metadata_props] == [p.value for p in native.metadata_props]
        onnx.save(made, path)
        assert float((stream_onnx(OnnxStream(path), CLIP) - expected).abs().max()) <= TOLERANCE


def test_older_opsets_have_other_operators_or_are_refused():
    graph = model(
        helper.make_node("LayerNormalization", ["x", "scale", "bias"], ["normal"], epsilon=1e-3),
        helper.make_node("Split", ["normal"], ["left", "right"], axis=1, num_outputs=2),
        helper.make_node("ReduceL2", ["left", "axes"], ["length"], keepdims=1),
        helper.make_node("Mul", ["right", "length"], ["y"]),
        scale=np.full(4, 2, np.float32),
        bias=np.ones(4, np.float32),
        axes=np.array([1], np.int64),
    )
    x = np.arange(8, dtype=np.float32).reshape(2, 4) ** 2
    expected = run(graph, x)
    for opset in OPSETS:
        np.testing.assert_allclose(run(convert_opset(graph, opset), x), expected, rtol=1e-5)
    kinds = {node.op_type for node in convert_opset(graph, 16).graph.node}
    assert "LayerNormalization" not in kinds
    assert "LayerNormalization" in {node.op_type for node in convert_opset(graph, 17).graph.node}
    assert "axes" not in {tensor.name for tensor in convert_opset(graph, 15).graph.initializer}
    with pytest.raises(InputError, match=r"opset=15: .*Mish"):
        convert_opset(model(helper.make_node("Mish", ["x"], ["y"])), 15)
    for opset in (14, 27):
        with pytest.raises(InputError, match=f"opset={opset}"):
            convert_opset(model(helper.make_node("Relu", ["x"], ["y"])), opset)
    rule = ExportConfig.__dataclass_fields__["opset"].metadata["rule"]
    assert [opset for opset in range(1, 40) if rule.allows(opset)] == list(OPSETS)
    assert ExportConfig.__dataclass_fields__["opset"].default == NATIVE


def run(graph: ModelProto, x: np.ndarray) -> np.ndarray:
    onnx.checker.check_model(graph, full_check=True)
    return onnx.reference.ReferenceEvaluator(graph).run(None, {"x": x})[0]
