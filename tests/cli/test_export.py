"""`memmlp export`: what it rejects, what it copies, and a file in fp16 for Unity."""

import json
import re
import subprocess
import sys
from pathlib import Path
from shutil import copyfile
from types import SimpleNamespace

import onnx
import pytest
import tiny
from cli.conftest import find_trained
from conftest import Memmlp, one_line
from onnx import TensorProto

from memmlp.cli import export as module
from memmlp.cli.export import ExportForm
from memmlp.common.errors import InputError

REJECTED = {
    "": "--out", "--out step.txt": "--out step.txt", "--out none/step.onnx": "there is no folder none",
    "--out a.onnx --rotations quaternion": "--scope full", "--out a.onnx --max-growth 2": "--max-growth 2",
    "--out a.onnx --precision int8 --scope full": "--scope step", "--out a.onnx": "0123",
}  # fmt: skip


def test_bad_options_are_rejected(memmlp: Memmlp, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for line, said in REJECTED.items():
        assert one_line(memmlp("export", "0123", *line.split()), said), line
        assert not list(tmp_path.iterdir())


def test_an_offline_network_has_no_file():
    model = tiny.baseline("bodiffusion", offline=True, sampling_steps=2, depth=1)
    for graph in ("auto", "naive"):
        with pytest.raises(InputError, match=r"model\.offline=true"):
            module.load(SimpleNamespace(network=lambda: model), ExportForm(graph, "fp32", 18, None))


@pytest.mark.slow
def test_a_deployed_file_is_copied_without_torch(home: Path, tmp_path: Path):
    run = find_trained(home)
    code = (
        "import sys; from memmlp.cli.main import main\n"
        "try: main(sys.argv[1:])\n"
        "except SystemExit as end: assert not end.code, end.code\n"
        "print(sorted({'torch', 'onnxruntime', 'hydra'} & set(sys.modules)))"
    )
    line = [sys.executable, "-c", code, "export", run.id, "--out", str(tmp_path / "step.onnx")]
    ran = subprocess.run(line, cwd=home, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    deployed = run.preferred_deployment
    assert f"differs from torch by at most {deployed.record['onnx_parity']:.1e}" in ran.stdout
    assert ran.stdout.endswith("[]\n")
    assert (tmp_path / "step.onnx").read_bytes() == deployed.onnx.read_bytes()


@pytest.mark.slow
def test_only_the_same_form_that_is_whole_is_copied(home: Path, tmp_path: Path):
    run, out = find_trained(home), tmp_path / "step.onnx"
    deployed = run.preferred_deployment
    record, fp32 = deployed.record, ExportForm("auto", "fp32", 18, None)
    for form in (fp32, fp32._replace(graph="streaming"), fp32._replace(precision="int8")):
        assert module.copy_deployed(run, out, form, 1e9), form
        out.unlink()
    others = ({"graph": "naive"}, {"opset": 17}, {"precision": "fp16"}, {"full": ("unity", "matrix")})
    for other in others:
        assert module.copy_deployed(run, out, fp32._replace(**other), 1e9) is None
    assert module.copy_deployed(run, out, fp32._replace(precision="int8"), -1.0) is None
    deployed.latency.write_text(json.dumps(record | {"settings": record["settings"] | {"graph": "naive"}}))
    assert module.copy_deployed(run, out, fp32, 1e9) is None
    deployed.latency.write_text(json.dumps(record))
    deployed.onnx.write_bytes(b"other")
    assert module.copy_deployed(run, out, fp32, 1e9) is None
    assert not out.exists()


@pytest.mark.long
def test_a_run_in_fp16_for_unity(home: Path, tmp_path: Path, memmlp: Memmlp, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(home)
    run = find_trained(home).id
    whole = ["--scope", "full", "--space", "unity", "--rotations", "quaternion", "--opset", "15"]
    files, write = {}, module.write_graph

    def kept(network: object, path: Path, run_id: str, form: ExportForm) -> None:
        write(network, path, run_id, form)
        files[form.full] = copyfile(path, tmp_path / f"{len(files)}.onnx")

    monkeypatch.setattr(module, "write_graph", kept)
    said = memmlp("export", run, "--out", "unity.onnx", *whole, "--precision", "fp16")
    assert said.code == 0, said.err
    assert "MPJPE" in said.out
    assert float(re.search(r"full graph differs from torch by at most (\S+)", said.out)[1]) < 0.01
    with monkeypatch.context() as patch:
        patch.setattr("memmlp.cli.export.FULL_TOLERANCE", 1e-9)
        patch.setattr(module, "write_graph", lambda *given: copyfile(files[given[-1].full], given[1]))
        said = memmlp("export", run, "--out", "none.onnx", *whole, "--precision", "fp16")
    assert said.code == 1
    assert "none.onnx: not written" in said.err
    assert not Path("none.onnx").exists()
    model = onnx.load("unity.onnx")
    onnx.checker.check_model(model, full_check=True)
    assert [one.version for one in model.opset_import] == [15]
    kinds = {tensor.data_type for tensor in model.graph.initializer}
    assert {TensorProto.FLOAT, TensorProto.FLOAT16} <= kinds
    shapes = {o.name: [d.dim_value for d in o.type.tensor_type.shape.dim] for o in model.graph.output}
    assert shapes["rotations"] == [1, 22, 4]
    assert not list(home.glob("*export*"))
