"""What lies outside of what runtimes publish: the lists, and how a graph is looked through."""

from __future__ import annotations

from pathlib import Path

import exported
import numpy as np
import onnx
import pytest
import tiny
from onnx import ModelProto, TensorProto, helper, numpy_helper

from memmlp.cli.export import TARGETS as NAMES
from memmlp.common.errors import InputError
from memmlp.deploy.operator_support import (
    KERNELS,
    TARGETS,
    Published,
    Rule,
    findings,
    load_graph,
    published,
    remarks,
)
from memmlp.deploy.opsets import converted
from memmlp.deploy.quantization import quantise
from memmlp.networks.streaming import streaming

LISTS = sorted({name for names in TARGETS.values() for name in names} - set(KERNELS))


@pytest.mark.parametrize("name", LISTS)
def test_lists_name_their_source_and_operators_that_there_are(name: str):
    listed = published(name)
    assert listed.title
    assert listed.version in listed.source
    assert listed.address in listed.source
    assert f"read {listed.read}" in listed.source
    assert listed.outside
    assert len(listed.operators) > 50
    domains = ("", "ai.onnx.ml")
    known = {schema.name for schema in onnx.defs.get_all_schemas_with_history() if schema.domain in domains}
    former = {"ImageScaler", "ParametricSoftplus", "ScaledTanh", "Inverse", "SimplifiedLayerNormalization"}
    names = {name for name in listed.operators if not name.startswith("com.microsoft.")}
    assert names - known - former - {"SkipSimplifiedLayerNormalization"} == set()
    for rule in listed.operators.values():
        rule.has(13)  # its versions can be read


def test_the_command_knows_the_same_targets():
    assert tuple(TARGETS) == NAMES


@pytest.mark.parametrize("name", KERNELS)
def test_onnx_runtime_names_its_own_kernels(name: str):
    listed = published(name)
    assert listed.operators["Split"].has(18)
    assert listed.operators["Split"].has(13)
    assert not listed.operators["Split"].has(1)
    assert "com.microsoft.QuickGelu" in listed.operators
    assert "onnxruntime 1." in listed.source


def graph(*nodes: onnx.NodeProto, opset: int = 18, **constants: np.ndarray) -> ModelProto:
    """Make a graph from x (2, 4) and i (1,) to y."""
    value = helper.make_tensor_value_info
    given = [value("x", TensorProto.FLOAT, [2, 4]), value("i", TensorProto.INT64, [1])]
    made = helper.make_graph(
        nodes,
        "graph",
        given,
        [value("y", TensorProto.FLOAT, None)],
        [numpy_helper.from_array(array, name) for name, array in constants.items()],
    )
    return helper.make_model(made, opset_imports=[helper.make_opsetid("", opset)], ir_version=10)


RULES = {
    "Relu": Rule("6-12,13"),
    "Slice": Rule(constant=(1, 2)),
    "Gemm": Rule(rank={2: 1}),
    "Add": Rule(types=("float16",), not_on=("GPU",), note="small ones"),
    "Abs": Rule(),
    "Constant": Rule(),
}
LIST = Published("list", "1", "somewhere", "it stops", RULES, opsets=(9, 17), folds=True)


def said(model: ModelProto) -> list[tuple[str, int, str]]:
    return [tuple(finding) for finding in findings(model, LIST)]


def test_what_a_list_does_not_have_is_found():
    node = helper.make_node
    one = np.array([1], np.int64)
    square, row = np.ones((4, 4), np.float32), np.ones((1, 4), np.float32)
    assert said(graph(node("Abs", ["x"], ["y"]), opset=13)) == []
    assert said(graph(node("Abs", ["x"], ["y"]))) == [("opset 18", 0, "published are 9 to 17")]
    pair = graph(node("Sin", ["x"], ["a"]), node("Sin", ["a"], ["y"]), opset=13)
    assert said(pair) == [("Sin (version 7)", 2, "not in the list")]
    assert said(graph(node("Relu", ["x"], ["y"]), opset=13)) == []
    assert said(graph(node("Relu", ["x"], ["y"]), opset=14)) == [
        ("Relu (version 14)", 1, "the list has version 6-12,13")
    ]
    assert said(graph(node("Slice", ["x", "one", "one"], ["y"]), opset=13, one=one)) == []
    assert said(graph(node("Slice", ["x", "i", "one"], ["y"]), opset=13, one=one)) == [
        ("Slice (version 13)", 1, "input 1 must be a constant")
    ]
    assert said(graph(node("Gemm", ["x", "b", "c"], ["y"]), opset=13, b=square, c=row[0])) == []
    assert said(graph(node("Gemm", ["x", "b", "c"], ["y"]), opset=13, b=square, c=row)) == [
        ("Gemm (version 13)", 1, "input 2 must have at most 1 dimensions")
    ]
    added = graph(node("Add", ["x", "x"], ["y"]), opset=13)
    assert said(added) == [("Add (version 13)", 1, "takes no float32")]
    assert remarks(added, LIST) == ["Add: not on GPU", "Add: small ones"]
    own = graph(node("Own", ["x"], ["y"], domain="com.own"), opset=13)
    assert said(own) == [("com.own.Own (version 1)", 1, "not in the list")]


def test_what_follows_from_constants_alone_is_computed_beforehand():
    node = helper.make_node
    model = graph(node("Sin", ["c"], ["s"]), node("Abs", ["s"], ["y"]), opset=13, c=np.ones(3, np.float32))
    assert said(model) == []
    unfolded = Published("list", "1", "somewhere", "it stops", RULES)
    assert [finding.what for finding in findings(model, unfolded)] == ["Sin (version 7)"]


def test_graphs_within_graphs_count():
    node = helper.make_node
    inner = helper.make_graph(
        [node("Sin", ["x"], ["z"])],
        "inner",
        [],
        [helper.make_tensor_value_info("z", TensorProto.FLOAT, [2, 4])],
    )
    condition = np.array(True)
    model = graph(node("If", ["c"], ["y"], then_branch=inner, else_branch=inner), opset=13, c=condition)
    assert ("Sin (version 7)", 2, "not in the list") in said(model)


@pytest.mark.slow
@pytest.mark.parametrize("network", ["mem_mlp", "avatar_poser", "manikin_s", "refined"])
def test_a_step_of_opset_15_is_within_what_engines_publish(step_files, network: str):
    model = converted(onnx.load(step_files(network)), 15)
    for name in ("onnxruntime", "wasm", "webgpu", "unity", "tensorrt", "qnn"):
        assert findings(model, published(name)) == [], name


@pytest.mark.slow
def test_int8_is_outside_of_what_unity_publishes(step_files, tmp_path: Path):
    ends = streaming(exported.NETWORKS["mem_mlp"]()).float32_modules
    quantise(step_files("mem_mlp"), tmp_path / "int8.onnx", ends, [tiny.clip(60)])
    model = load_graph(tmp_path / "int8.onnx")
    lacking = {finding.what.split()[0] for finding in findings(model, published("unity"))}
    assert {"QuantizeLinear", "DequantizeLinear"} <= lacking
    assert findings(model, published("wasm")) == []
    assert "QuantizeLinear" in {finding.what.split()[0] for finding in findings(model, published("webgpu"))}


def test_what_is_no_onnx_file_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="no such file"):
        load_graph(tmp_path / "none.onnx")
    for content in (b"", b"no graph"):
        (tmp_path / "bad.onnx").write_bytes(content)
        with pytest.raises(InputError, match=r"no ONNX file|without a graph"):
            load_graph(tmp_path / "bad.onnx")
