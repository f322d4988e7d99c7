"""`memmlp export`: what it rejects, what it copies, and a file in fp16 for Unity."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest
import tiny
from cli.conftest import find_trained
from conftest import Memmlp, one_line

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
