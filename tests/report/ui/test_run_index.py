"""The index follows run folders, and shows damage as damage."""

import json
from pathlib import Path

import pytest
from fake_runs import write_evaluation
from report.ui.conftest import run_of, started_run

from memmlp.common.lease import Lock
from memmlp.report.ui import run_index
from memmlp.report.ui.run_index import RunIndex, list_preparations, read_facts


def test_facts_of_a_finished_run(outputs: Path):
    run = run_of(outputs, "gru", 1)
    (run.folder / "notes.json").write_text(json.dumps({"tags": ["good"], "note": "<b>look</b>"}))
    found = read_facts(run.folder)
    assert (found["id"], found["done"], found["steps"], found["damage"]) == (run.id, True, 2000, [])
    error = run.results["stream"]["rotation"]["MPJPE"]
    assert found["metrics"]["stream.rotation.MPJPE"] == pytest.approx(error)
    assert found["metrics"]["latency.median_ms"] == pytest.approx(0.64)
    assert (found["tags"], found["note"]) == (["good"], "<b>look</b>")
    assert found["recent"][-1][0] == 2000
    path = run.deployment("fp32-0").latency
    record = json.loads(path.read_text())
    changes = {"settings": {"precision": "int8"}, "int8": {"median_ms": 0.32, "onnx_bytes": 7}}
    path.write_text(json.dumps(record | changes))
    run.config_path.write_text(json.dumps(run.config | {"export": {"precision": "int8"}}))
    found = read_facts(run.folder)["metrics"]
    assert (found["latency.median_ms"], found["latency.onnx_bytes"]) == (0.32, 7)
    assert found["latency.parameters"] == record["parameters"]


@pytest.mark.parametrize(("name", "content", "damaged"), [
    ("manifest.json", b"{", "manifest.json"), ("config.yaml", b"a: [", "config.yaml"),
    ("config.yaml", b"\xff\xfe", "config.yaml"), ("config.yaml", b"- a list", "config.yaml"),
    ("evaluations/stream-0.json", b'{"mean": 3}', "evaluations/stream-0.json"),
    ("notes.json", b"[1]", "notes.json"), ("metrics.jsonl", b"\x00\x00 no line\n{}\n", "metrics.jsonl"),
    ("deployments/fp32-0/latency.json", b"[", "deployments/fp32-0/latency.json"),
    ("FAILED", b"[]", "FAILED"), (".holder", b'{"pid": "no number", "host": 3}', None),
])  # fmt: skip
def test_damage_is_listed_and_raises_nothing(outputs: Path, name: str, content: bytes, damaged: str | None):
    run = run_of(outputs)
    (run.folder / name).write_bytes(content)
    index = RunIndex(outputs)
    index.refresh()
    assert len(index.runs) == 6
    damage = index.runs[run.id]["damage"]
    assert [line.partition(":")[0] for line in damage] == ([damaged] if damaged else [])
    assert index.runs[run.id]["status"] == ("damaged" if damaged else "done")


def test_only_what_changed_is_parsed_again(outputs: Path, monkeypatch: pytest.MonkeyPatch):
    parsed = []
    monkeypatch.setattr(run_index, "read_facts", lambda one: parsed.append(one.name) or read_facts(one))
    index = RunIndex(outputs)
    first = index.refresh()
    assert (index.refresh(), len(parsed)) == (first, 6)
    run = started_run(outputs)
    second = index.refresh()
    assert (second != first, parsed[6:]) == (True, [run.id])
    assert index.runs[run.id]["status"] == "interrupted"
    run.log(600, {"loss": 1.0})
    assert index.refresh() != second
    assert (parsed[6:], index.runs[run.id]["recent"][-1][0]) == ([run.id], 600)
    for path in run.folder.iterdir():
        path.unlink()
    run.folder.rmdir()
    assert index.refresh() == first
    assert run.id not in index.runs
    new = RunIndex(outputs)
    new.refresh(seconds=-1)
    assert (new.runs, new.unread) == ({}, 6)
    assert (new.refresh() == first, new.unread) == (True, 0)


def test_a_run_is_not_done_while_it_is_evaluated_or_once_its_deployment_failed(outputs: Path):
    index, run = RunIndex(outputs), run_of(outputs)

    def status() -> str:
        index.refresh()
        return index.runs[run.id]["status"]

    with run.lock():
        run.attempt("evaluation")
        assert status() == "evaluating"
    assert status() == "done"
    run.fail("RuntimeError: ONNX Runtime differs from torch")
    assert (run.status, status()) == ("failed", "failed")
    run.retry()
    assert status() == "done"


def test_numbers_are_marked_where_a_reader_must_know_more(outputs: Path):
    run = run_of(outputs)
    path = run.deployment("fp32-0").latency
    path.write_text(json.dumps(json.loads(path.read_text()) | {"core_share": 0.5}))
    report = next(run.evaluations.glob("stream*"))
    content = json.loads(report.read_text())
    content["mean"]["rotation"]["Jitter"] = "nan"
    write_evaluation(report, content)
    found = read_facts(run.folder)
    assert found["marks"]["errors"].startswith("hardly trained")
    assert found["marks"]["latency"] == "timed on a busy machine: a core was free 50% of the time"
    assert found["metrics"]["stream.rotation.Jitter"] == "nan"
    assert (found["after"], found["batch"]) == (20.0, 1)
    assert read_facts(started_run(outputs).folder)["marks"] == {}


def test_data_that_is_prepared_is_seen(tmp_path: Path):
    cache = tmp_path / "cache" / "mocap"
    cache.mkdir(parents=True)
    (cache / "train.npy").write_bytes(b"123")
    assert list_preparations(tmp_path) == []
    with Lock(cache).hold():
        (found,) = list_preparations(tmp_path)
        assert found["name"] == "mocap"
        assert found["bytes"] >= 3
