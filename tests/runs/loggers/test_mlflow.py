"""MLflow shows what the run folder holds, once, and replaces what it had."""

import math
import os
from pathlib import Path
from typing import Any

import pytest
from fake_logger import a_run as begun
from fake_logger import an_outdated_evaluation

from memmlp.common.files import write_json
from memmlp.runs.loggers.logger import Session, sync_runs
from memmlp.runs.loggers.mlflow import MLflow
from memmlp.runs.lookup import add_tags, edit_notes, remove_tags
from memmlp.runs.run import Run

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module", autouse=True)
def _needs_mlflow() -> None:
    """Not imported by each test process."""
    pytest.importorskip("mlflow")


CONFIG = {"data": {"name": "mine"}, "seed": 0, "memory": {"layers": [2, 4]}, "long": "x" * 7000}


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of MLflow's database, which takes seconds to make."""
    return tmp_path_factory.mktemp("mlflow")


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


def shown(store: Path) -> dict[str, Any]:
    """MLflow's runs by our id."""
    with MLflow(None, store).client() as (client, experiment):
        runs = client.search_runs([experiment])
    found = {run.data.tags["memmlp.run_id"]: run for run in runs}
    assert len(found) == len(runs)
    return found


def history(store: Path, run: Run, key: str) -> list[tuple[int, float]]:
    mlflow_id = shown(store)[run.id].info.run_id
    with MLflow(None, store).client() as (client, _):
        return [(metric.step, metric.value) for metric in client.get_metric_history(mlflow_id, key)]


def test_a_run_from_its_start_to_its_end(store: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    logger, run = MLflow(None, store), a_run(tmp_path)
    run.write_manifest(
        {"name": "memory=gru · seed 1", "user": "somebody", "git": {"commit": "c" * 40, "dirty": False}}
    )
    session = Session(logger, run)
    session.update()
    assert shown(store)[run.id].info.status == "RUNNING"
    assert logger.fingerprint(run.id) is None
    run.log(6, {"loss": 0.1, "new": 1.0})
    session.update()
    run.finish(["results.json"])
    session.end()
    found = shown(store)[run.id]
    assert (found.info.status, found.info.run_name) == ("FINISHED", "memory=gru · seed 1")
    assert (found.data.tags["memmlp.prerequisite"], found.data.tags["mlflow.user"]) == ("u", "somebody")
    assert found.data.tags["mlflow.source.git.commit"] == "c" * 40
    (given,) = found.inputs.dataset_inputs
    assert (given.dataset.name, given.dataset.digest) == ("mine", "d")
    assert history(store, run, "train/loss") == [(step, 1 / step) for step in range(1, 6)] + [(6, 0.1)]
    assert [math.isnan(value) for _, value in history(store, run, "train/bad")] == [True] * 5
    assert found.data.params == {
        "data.name": "mine", "seed": "0", "memory.layers": "[2, 4]", "long": "x" * 6000,
    }  # fmt: skip
    assert found.data.metrics["stream/rotation/MPJPE"] == 6.5
    assert "note" not in found.data.metrics
    names = {"config.yaml", "results.json", "step.onnx", "latency.json"}
    with logger.client() as (client, _):
        files = {item.path for item in client.list_artifacts(found.info.run_id)}
    assert files - {"code.patch"} == names
    assert (store / "mlflow-artifacts").is_dir()
    assert sync_runs(logger, [run], print) == {"same": 1}
    assert capfd.readouterr() == ("", "")


def test_what_changed_replaces_the_run(store: Path, tmp_path: Path):
    logger, run = MLflow(None, store), a_run(tmp_path)
    add_tags(run, ["good"])
    edit_notes(run, note="a note")
    outdated = an_outdated_evaluation(run)
    sync_runs(logger, [run], print)
    tags = shown(store)[run.id].data.tags
    assert (tags["memmlp.label.good"], tags["mlflow.note.content"]) == ("good", "a note")
    assert tags["memmlp.outdated_results"].startswith("stream (mode.stream 0 -> ")
    remove_tags(run, ["good"])
    edit_notes(run, note="")
    outdated.unlink()
    run.log(5, {"loss": 77.0})
    run.fail("loss is nan at step 5")
    other = a_run(tmp_path, "1" * 16)
    assert sync_runs(logger, [run, other], print) == {"shown": 2}
    found = shown(store)
    assert [found[one.id].info.status for one in (run, other)] == ["FAILED", "KILLED"]
    tags = found[run.id].data.tags
    assert tags["memmlp.failure"] == "loss is nan at step 5"
    assert not {"memmlp.label.good", "mlflow.note.content", "memmlp.outdated_results"} & tags.keys()
    assert history(store, run, "train/loss") == [*((step, 1 / step) for step in range(1, 5)), (5, 77.0)]


def test_a_server_that_is_not_there_is_told(tmp_path: Path):
    said: list[str] = []
    assert sync_runs(MLflow("http://127.0.0.1:9", tmp_path), [begun(tmp_path)], said.append) == {"failed": 1}
    assert said[0].startswith(f"run {'0' * 16} is not shown in mlflow: ")


def test_any_folder_and_any_tag_and_a_deleted_experiment_is_restored_without_replaced_runs(tmp_path: Path):
    name, tags = "a?b#c 50%20d", ["a+b", "a//b", "v1/../y", "é"]
    logger, run = MLflow(None, outputs := tmp_path / name / "outputs"), a_run(tmp_path / name / "outputs")
    add_tags(run, tags)
    before = os.umask(0o002)
    try:
        assert sync_runs(logger, [run], print) == {"shown": 1}
    finally:
        os.umask(before)
    assert sorted(path.name for path in tmp_path.iterdir()) == [name]
    assert (outputs / "mlflow.db").stat().st_mode & 0o777 == 0o664
    found = shown(outputs)[run.id].data.tags
    assert {value for key, value in found.items() if key.startswith("memmlp.label.")} == {*tags}
    add_tags(run, ["again"])
    sync_runs(logger, [run], print)
    with logger.client() as (client, experiment):
        client.delete_experiment(experiment)
    assert sync_runs(logger, [run], print) == {"shown": 1}
    assert [*shown(outputs)] == [run.id]
