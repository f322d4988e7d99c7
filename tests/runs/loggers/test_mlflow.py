"""MLflow shows what the run folder holds, once, and replaces what it had."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
from fake_logger import a_run as begun
from fake_logger import an_outdated_evaluation

from memmlp.common.files import write_json
from memmlp.runs.loggers.logger import Session, sync_runs
from memmlp.runs.loggers.mlflow import MLflow
from memmlp.runs.lookup import add_tags, remove_tags, set_note
from memmlp.runs.run import Run

pytest.importorskip("mlflow")
pytestmark = pytest.mark.slow

CONFIG = {
    "data": {"name": "mine"},
    "seed": 0,
    "memory": {"layers": [2, 4]},
    "long": "x" * 7000,
}


def a_run(outputs: Path, name: str = "0" * 16) -> Run:
    run = Run.from_id(outputs, name)
    run.begin("memmlp", CONFIG, data="d", prerequisite="u")
    for step in range(1, 6):
        run.log(step, {"loss": 1 / step, "bad": math.nan})
    write_json(run.results_path, {"stream": {"rotation": {"MPJPE": 6.5}}, "note": "text"})
    place = run.deployment("fp32-0")
    place.folder.mkdir(parents=True, exist_ok=True)
    place.onnx.write_bytes(b"onnx")
    place.finish({"settings": {}})
    run.checkpoint.write_bytes(b"large")
    return run


def shown(outputs: Path) -> dict[str, Any]:
    """MLflow's runs by our id, or by the name of a sweep."""
    with MLflow(None, outputs).client() as (client, experiment):
        runs = client.search_runs([experiment])
    tags = ("memmlp.sweep", "memmlp.run_id")
    found = {next(run.data.tags[key] for key in tags if key in run.data.tags): run for run in runs}
    assert len(found) == len(runs)
    return found


def history(outputs: Path, run: Run, key: str) -> list[tuple[int, float]]:
    mlflow_id = shown(outputs)[run.id].info.run_id
    with MLflow(None, outputs).client() as (client, _):
        return [(metric.step, metric.value) for metric in client.get_metric_history(mlflow_id, key)]


def files(outputs: Path, name: str) -> set[str]:
    mlflow_id = shown(outputs)[name].info.run_id
    with MLflow(None, outputs).client() as (client, _):
        return {item.path for item in client.list_artifacts(mlflow_id)}


def test_a_run_from_its_start_to_its_end(tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    logger, run = MLflow(None, tmp_path), a_run(tmp_path)
    run.write_manifest({"name": "memory=gru · seed 1", "user": "somebody", "git": {"commit": "c" * 40}})
    session = Session(logger, run)
    session.update()
    assert shown(tmp_path)[run.id].info.status == "RUNNING"
    assert logger.fingerprint(run.id) is None
    run.log(6, {"loss": 0.1, "new": 1.0})
    session.update()
    run.finish(["results.json"])
    session.end()
    found = shown(tmp_path)[run.id]
    assert (found.info.status, found.info.run_name) == ("FINISHED", "memory=gru · seed 1")
    assert (found.data.tags["memmlp.prerequisite"], found.data.tags["mlflow.user"]) == ("u", "somebody")
    assert found.data.tags["mlflow.source.git.commit"] == "c" * 40
    (given,) = found.inputs.dataset_inputs
    assert (given.dataset.name, given.dataset.digest) == ("mine", "d")
    assert history(tmp_path, run, "train/loss") == [(step, 1 / step) for step in range(1, 6)] + [(6, 0.1)]
    assert [math.isnan(value) for _, value in history(tmp_path, run, "train/bad")] == [True] * 5
    assert found.data.params == {
        "data.name": "mine", "seed": "0", "memory.layers": "[2, 4]", "long": "x" * 6000,
    }  # fmt: skip
    assert found.data.metrics["stream/rotation/MPJPE"] == 6.5
    assert "note" not in found.data.metrics
    names = {"config.yaml", "results.json", "step.onnx", "latency.json"}
    assert files(tmp_path, run.id) - {"code.patch"} == names
    assert (tmp_path / "mlflow-artifacts").is_dir()
    assert sync_runs(logger, [run], print) == {"same": 1}
    assert capfd.readouterr() == ("", "")


def test_what_changed_replaces_the_run(tmp_path: Path):
    """MLflow can't take a value back."""
    logger, run = MLflow(None, tmp_path), a_run(tmp_path)
    add_tags(run, ["good"])
    set_note(run, "a note")
    outdated = an_outdated_evaluation(run)
    sync_runs(logger, [run], print)
    tags = shown(tmp_path)[run.id].data.tags
    assert (tags["memmlp.label.good"], tags["mlflow.note.content"]) == ("yes", "a note")
    assert tags["memmlp.outdated_results"].startswith("stream (mode.stream 0 -> ")
    remove_tags(run, ["good"])
    set_note(run, "")
    outdated.unlink()
    run.log(5, {"loss": 77.0})
    run.fail("loss is nan at step 5")
    other = a_run(tmp_path, "1" * 16)
    assert sync_runs(logger, [run, other], print) == {"shown": 2}
    found = shown(tmp_path)
    assert [found[one.id].info.status for one in (run, other)] == ["FAILED", "KILLED"]
    tags = found[run.id].data.tags
    assert tags["memmlp.failure"] == "loss is nan at step 5"
    assert not {"memmlp.label.good", "mlflow.note.content", "memmlp.outdated_results"} & tags.keys()
    assert history(tmp_path, run, "train/loss") == [*((step, 1 / step) for step in range(1, 5)), (5, 77.0)]


def test_many_values_go_in_batches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from mlflow import MlflowClient

    sizes: list[tuple[int, int]] = []
    log_batch = MlflowClient.log_batch

    def spy(client: Any, run_id: str, metrics: Any = (), params: Any = (), tags: Any = ()) -> None:
        sizes.append((len(metrics), len(params)))
        log_batch(client, run_id, metrics=metrics, params=params, tags=tags)

    monkeypatch.setattr(MlflowClient, "log_batch", spy)
    run = Run.from_id(tmp_path, "2" * 16)
    run.begin("memmlp", {f"key{i}": i for i in range(250)}, data="d", prerequisite=None)
    for step in range(600):
        run.log(step, {"a": 1.0, "b": 2.0})
    sync_runs(MLflow(None, tmp_path), [run], print)
    assert [size for size in sizes if size != (0, 0)] == [(0, 100), (0, 100), (0, 50), (1000, 0), (200, 0)]
    assert len(history(tmp_path, run, "train/b")) == 600


def test_a_server_that_is_not_there_is_told(tmp_path: Path):
    said: list[str] = []
    assert sync_runs(MLflow("http://127.0.0.1:9", tmp_path), [begun(tmp_path)], said.append) == {"failed": 1}
    assert said[0].startswith(f"run {'0' * 16} is not shown in mlflow: ")


"""Processes that have imported MLflow, and do not know its store yet, which is not there."""
