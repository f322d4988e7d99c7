"""`memmlp export`: what it refuses, and what it says of the operators that targets publish."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace

import onnx
import pytest
import tiny
from conftest import Memmlp, one_line
from onnx import TensorProto, helper

from memmlp.cli.export import Form
from memmlp.cli.export import write as write_run
from memmlp.common.errors import InputError
from memmlp.runs.lookup import is_trained, list_runs


def write(path: Path, *kinds: str, opset: int = 15) -> None:
    """Write an ONNX file of operators, one after the other."""
    names = ["x", *(f"h{index}" for index in range(1, len(kinds))), "y"]
    value = helper.make_tensor_value_info
    nodes = [helper.make_node(kind, [names[i]], [names[i + 1]]) for i, kind in enumerate(kinds)]
    ends = [[value(name, TensorProto.FLOAT, [2])] for name in ("x", "y")]
    graph = helper.make_graph(nodes, "graph", *ends)
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=8)
    onnx.save(made, path)


def test_a_file_is_checked_without_a_run(memmlp: Memmlp, tmp_path: Path):
    fine, other = tmp_path / "fine.onnx", tmp_path / "other.onnx"
    write(fine, "Relu", "Sigmoid")
    said = memmlp("export", str(fine), "--operators-for", "unity", "--operators-for", "tensorrt")
    assert said.code == 0
    assert said.out.startswith("fine.onnx: 2 nodes of 2 operators\nunity: ")
    assert said.out.count("  all operators are published\n") == 2
    assert "com.unity.ai.inference 2.4.0, 2025-10-22 (https://docs.unity3d.com" in said.out
    write(other, "Relu", "Det", "Det", opset=18)
    said = memmlp("export", str(other), "--operators-for", "unity", "--operators-for", "onnxruntime")
    assert said.code == 1
    assert "  opset 18: published are 7 to 15\n  Det (version 11), 2 nodes: not in the list\n" in said.out
    assert "other.onnx: outside of what unity publishes" in said.err


def test_no_number_of_clips_is_below_zero(memmlp: Memmlp):
    assert one_line(
        memmlp("export", "0123", "--out", "a.onnx", "--parity-clips", "-1"), "--parity-clips", "-1"
    )


def test_web_is_all_of_its_backends(memmlp: Memmlp, tmp_path: Path):
    write(tmp_path / "step.onnx", "Relu", "Sign")
    said = memmlp("export", str(tmp_path / "step.onnx"), "--operators-for", "web")
    assert [line.partition(":")[0] for line in said.out.splitlines() if line.startswith("w")] == [
        "wasm",
        "webgpu",
        "webnn",
    ]
    assert "Sign (version 13), 1 nodes: not in the list\n  so WebAssembly on the CPU" in said.out
    assert "outside of what webgpu publishes" in said.err


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (["step.onnx"], "allowed with it is --operators-for alone"),
        (
            ["step.onnx", "--operators-for", "unity", "--out", "other.onnx"],
            "allowed with it is --operators-for alone",
        ),
        (
            ["step.onnx", "--operators-for", "unity", "--precision", "int8"],
            "allowed with it is --operators-for alone",
        ),
        (["none.onnx", "--operators-for", "unity"], "none.onnx: no such file"),
        (["0123"], "--out: is missing; it may be left out with --operators-for alone"),
        (["0123", "--out", "step.txt"], "allowed ending is .onnx"),
        (["0123", "--out", "none/step.onnx"], "there is no folder none"),
        (["0123", "--out", "a.onnx", "--rotations", "quaternion"], "allowed with --scope full"),
        (
            ["0123", "--out", "a.onnx", "--max-growth", "2"],
            "allowed with --precision fp16, int8 or int8_blocks",
        ),
        (
            ["0123", "--out", "a.onnx", "--precision", "int8", "--parity-clips", "3"],
            "measured on all test clips",
        ),
    ],
)
def test_what_does_not_go_together_is_refused(
    memmlp: Memmlp, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, line: list[str], words: str
):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "step.onnx", "Relu")
    assert one_line(memmlp("export", *line), words)
    assert [path.name for path in tmp_path.iterdir()] == ["step.onnx"]


@pytest.mark.parametrize("graph", ["auto", "naive"])
def test_a_network_that_makes_frames_with_later_ones_has_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, graph: str
):
    """A step of it would make another motion than was evaluated."""
    model = tiny.baseline("bodiffusion", offline=True, sampling_steps=2, depth=1)
    experiment = SimpleNamespace(architecture=SimpleNamespace(load=lambda _: model))
    data = SimpleNamespace(open=lambda _: tiny.frames((10,)))
    monkeypatch.setattr("memmlp.config.open_run.open_run", lambda *_: (None, experiment, data))
    run = SimpleNamespace(id="0123", weights=lambda: None)
    monkeypatch.setattr("memmlp.runs.lookup.find_run", lambda *_: run)
    monkeypatch.setattr("memmlp.cli.export.write_exact", lambda *_: None)  # takes seconds
    with pytest.raises(InputError, match=r"model\.offline=true"):
        write_run("0123", tmp_path / "step.onnx", tmp_path, Form(graph, "fp32", 18, None), 1, 0.01)


@pytest.mark.slow
def test_a_run_in_fp16_for_unity(home: Path, memmlp: Memmlp, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(home)
    (run,) = (found.id for found in list_runs(Path("outputs")) if is_trained(found))
    whole = ["--scope", "full", "--space", "unity", "--rotations", "quaternion", "--opset", "15"]
    said = memmlp(
        "export", run, "--out", "unity.onnx", *whole, "--precision", "fp16", "--operators-for", "unity"
    )
    assert said.code == 0
    assert "MPJPE" in said.out
    assert float(re.search(r"whole way differs from torch by (\S+) at most", said.out)[1]) < 0.01
    with monkeypatch.context() as patch:
        patch.setattr("memmlp.cli.export.FULL_TOLERANCE", 1e-9)
        said = memmlp("export", run, "--out", "none.onnx", *whole, "--precision", "fp16")
    assert said.code == 1
    assert "more than 1e-09: not written" in said.err
    assert not Path("none.onnx").exists()
    model = onnx.load("unity.onnx")
    onnx.checker.check_model(model, full_check=True)
    assert [one.version for one in model.opset_import] == [15]
    kinds = {tensor.data_type for tensor in model.graph.initializer}
    assert {TensorProto.FLOAT, TensorProto.FLOAT16} <= kinds
    shapes = {o.name: [d.dim_value for d in o.type.tensor_type.shape.dim] for o in model.graph.output}
    assert shapes["rotations"] == [1, 22, 4]
    assert one_line(memmlp("export", run, "--out", "a.onnx", *whole, "--precision", "int8"), "--scope step")
    said = memmlp("export", run, "--operators-for", "unity")
    assert said.code == 1
    assert f"{run}.onnx: outside of what unity publishes" in said.err
    assert not list(home.glob("*export*"))
