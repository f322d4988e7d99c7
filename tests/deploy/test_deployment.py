"""Deployments: the exported graph, int8 and its cost, and what a run records of them."""

import json
import math
from pathlib import Path
from shutil import copyfile

import exported
import onnx
import pytest
import tiny
from conftest import one_line

import memmlp as package
from memmlp.deploy.lower_precision import write_lower_precision
from memmlp.deploy.onnx_stream import OnnxStream
from memmlp.deploy.parity import stream_onnx
from memmlp.networks.streaming import make_streaming_graph
from memmlp.runs.lookup import list_runs

pytestmark = pytest.mark.slow

CLIPS = [tiny.clip(60, seed=seed) for seed in range(3)]


@pytest.fixture(scope="module")
def pair(step_files, tmp_path_factory) -> tuple[Path, Path]:
    exact, quantised = step_files("mem_mlp"), tmp_path_factory.mktemp("pair") / "int8.onnx"
    write_lower_precision(
        "int8", exact, quantised, make_streaming_graph(exported.NETWORKS["mem_mlp"]()), CLIPS
    )
    return exact, quantised


def test_int8_is_near_and_keeps_the_metadata(pair):
    exact, quantised = pair
    before, after = (stream_onnx(OnnxStream(path), CLIPS[0]) for path in pair)
    assert 1e-6 < float((before - after).abs().mean()) < 0.02
    props = [{p.key: p.value for p in onnx.load(path).metadata_props} for path in pair]
    assert props[0].items() <= props[1].items()
    assert quantised.parent != exact.parent
    assert [path.name for path in quantised.parent.iterdir()] == ["int8.onnx"]
    for path in pair:  # neither where it was made nor lines of code, which an exporter notes on each node
        written = path.read_bytes()
        for private in (str(Path(package.__file__).parent), str(Path.home()), "stack_trace", "torch.export"):
            assert private.encode() not in written


def test_a_run_in_int8_records_what_it_costs(home, memmlp, monkeypatch):
    monkeypatch.chdir(home)
    (made,) = (found for found in list_runs(home / "outputs") if found.manifest["kind"] == "memmlp")
    deployed = made.preferred_deployment
    written = deployed.latency.read_text()
    record = json.loads(written)
    assert record["graph"] == "streaming"
    assert not any(name.startswith("alone") for name in record)
    assert 0 < record["step_macs"] != record["macs"]  # of so small a network the graph's may be more
    cost = record["int8"]
    assert cost["growth"] == pytest.approx(cost["int8"]["MPJPE"] / cost["fp32"]["MPJPE"] - 1)
    assert cost["median_ms"] > 0
    assert cost["pose_median_ms"] > 0
    assert 0 < record["pose_median_ms"] <= record["pose_p95_ms"]
    assert cost["onnx_bytes"] == deployed.int8.stat().st_size
    assert made.verify() == []
    assert math.isclose(cost["fp32"]["MPJPE"], made.results["stream"]["rotation"]["MPJPE"], rel_tol=1e-3)
    for jitter, used in ((0.1, deployed.int8), (0.36, deployed.onnx)):  # an error as small, but more unrest
        cost |= {"growth": 0.001, "jitter_growth": jitter, "default": True}
        deployed.latency.write_text(json.dumps(record))
        assert made.preferred_onnx == used
        assert package.Stream(made).network.path == used
        assert package.Stream(str(made.folder)).network.path == used
    deployed.latency.write_text(written)
    assert made.verify() == []
    deployed.int8.write_bytes(b"")
    assert made.verify() == [f"deployments/{deployed.folder.name}/step.int8.onnx"]

    # The float32 file is exported as it is without int8 (tests/training/test_run_stages.py).
    monkeypatch.setattr(
        "memmlp.deploy.export.export", lambda model, path, run, opset: copyfile(deployed.onnx, path)
    )
    line = ["export", made.id, "--out", "int8.onnx", "--precision", "int8"]
    assert "MPJPE" in memmlp(*line, "--max-growth", "50").out
    Path("int8.onnx").unlink()
    refused = memmlp(*line, "--max-growth", "-100")
    assert refused.code == 1
    assert "not written" in refused.err
    assert sorted(path.name for path in home.iterdir()) == ["out.txt", "outputs"]
    assert one_line(memmlp(*line, "--graph", "naive"), "--precision int8")
