"""MLflow shows what the run folder holds, can be asked twice, and replaces what contradicts the folder."""

from __future__ import annotations

import logging
import math
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from fake_logger import an_outdated_evaluation
from processes import finished

from memmlp.common.files import write_json
from memmlp.experiment_tracking.logged_values import SweepFacts
from memmlp.experiment_tracking.mlflow_logger import MLflow, allowed, quiet
from memmlp.experiment_tracking.run_logger import Session
from memmlp.experiment_tracking.sync import sync
from memmlp.runs.notes import add_tags, remove_tags, set_note
from memmlp.runs.run import Run

pytestmark = pytest.mark.slow

CONFIG = {
    "data": {"name": "mine"}, "seed": 0, "memory": {"layers": [2, 4], "shift": None}, "long": "x" * 7000,
}  # fmt: skip


def a_run(outputs: Path, name: str = "0" * 16) -> Run:
    run = Run.of(outputs, name)
    run.begin("memmlp", CONFIG, data="d", upstream="u")
    for step in range(1, 6):
        run.log(step, {"loss": 1 / step, "bad": math.nan})
    write_json(run.results_path, {"stream": {"rotation": {"MPJPE": 6.5}}, "note": "text"})
    place = run.deployment("fp32-0")
    place.folder.mkdir(parents=True, exist_ok=True)
    place.onnx.write_bytes(b"onnx")
    place.finish({"settings": {}})
    run.checkpoint.write_bytes(b"large")
    return run


def project(tracking: MLflow, run: Run) -> None:
    """Show the run as it is now."""
    session = Session(tracking, run, tracking.outputs / "ledgers")
    session.end()
    session.leave()


def client_of(outputs: Path) -> Any:
    from mlflow import MlflowClient

    return MlflowClient(f"sqlite:///{outputs / 'mlflow.db'}")


def shown(outputs: Path) -> list[Any]:
    with quiet():  # what SQLAlchemy says of MLflow's tables, when they are first used
        client = client_of(outputs)
        return client.search_runs([client.get_experiment_by_name("memmlp").experiment_id])


def steps(outputs: Path, key: str) -> list[tuple[int, float]]:
    (run,) = shown(outputs)
    return [(m.step, m.value) for m in client_of(outputs).get_metric_history(run.info.run_id, key)]


@pytest.fixture(scope="module")
def projected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An outputs folder with one run, projected when unfinished, when longer, and when done, twice."""
    outputs = tmp_path_factory.mktemp("outputs")
    tracking, run = MLflow(None, outputs), a_run(outputs)
    session = Session(tracking, run, outputs / "ledgers")
    session.step()
    assert [one.info.status for one in shown(outputs)] == ["RUNNING"]
    session.leave()
    run.begin("memmlp", CONFIG | {"seed": 0.5}, data="d", upstream="u")  # resumed with other settings
    run.write_manifest({"name": "memory=gru · seed 1", "user": "somebody", "git": {"commit": "c" * 40}})
    time.sleep(0.01)
    run.log(5, {"loss": 1 / 5})  # repeated
    run.log(6, {"loss": 0.1, "new": 1.0})
    project(tracking, run)
    run.finish(["results.json"])
    project(tracking, run)
    project(tracking, run)
    return outputs


def test_one_run_however_often_it_is_shown(projected: Path):
    (run,) = shown(projected)
    assert run.info.status == "FINISHED"
    assert (run.data.tags["memmlp.run_id"], run.data.tags["memmlp.upstream"]) == ("0" * 16, "u")


def test_a_name_for_people_user_source_and_dataset(projected: Path):
    (run,) = shown(projected)
    assert run.info.run_name == "memory=gru · seed 1"
    assert run.data.tags["mlflow.user"] == "somebody"
    assert run.data.tags["mlflow.source.git.commit"] == "c" * 40
    (given,) = run.inputs.dataset_inputs
    assert (given.dataset.name, given.dataset.digest) == ("mine", "d")


def test_tags_and_notes_come_and_go(projected: Path):
    tracking, run = MLflow(None, projected), Run.of(projected, "0" * 16)
    add_tags(run, ["good"])
    set_note(run, "a note")
    outdated = an_outdated_evaluation(run)
    project(tracking, run)
    tags = shown(projected)[0].data.tags
    assert (tags["memmlp.label.good"], tags["mlflow.note.content"]) == ("yes", "a note")
    assert tags["memmlp.by_an_earlier_recipe"].startswith("stream (mode.stream 0 -> ")
    remove_tags(run, ["good"])
    set_note(run, "")
    outdated.unlink()
    project(tracking, run)
    (found,) = shown(projected)
    gone = {"memmlp.label.good", "mlflow.note.content", "memmlp.by_an_earlier_recipe"}
    assert gone & set(found.data.tags) == set()


def test_no_step_twice(projected: Path):
    expected = [(step, 1 / step) for step in range(1, 6)] + [(6, 0.1)]
    assert steps(projected, "train/loss") == expected
    assert steps(projected, "train/new") == [(6, 1.0)]
    assert [math.isnan(value) for _, value in steps(projected, "train/bad")] == [True] * 4


def test_params_and_results(projected: Path):
    (run,) = shown(projected)
    assert run.data.params == {
        "data.name": "mine",
        "seed": "0.5",
        "memory.layers": "[2, 4]",
        "memory.shift": "None",
        "long": "x" * 6000,
    }
    assert run.data.metrics["stream/rotation/MPJPE"] == 6.5
    assert "note" not in run.data.metrics


def test_small_artifacts_lie_in_the_outputs(projected: Path):
    (run,) = shown(projected)
    names = {item.path for item in client_of(projected).list_artifacts(run.info.run_id)}
    assert names - {"code.patch"} == {"config.yaml", "results.json", "step.onnx", "latency.json"}
    assert (projected / "mlflow-artifacts").is_dir()


def test_a_run_done_again_replaces_the_old_one(projected: Path):
    run = Run.of(projected, "1" * 16)
    tracking = MLflow(None, projected)
    for started in ("2024-01-01T00:00:00+00:00", "2025-01-01T00:00:00+00:00"):
        run.reset()
        run.begin("memmlp", CONFIG, data="d", upstream=None)
        run.write_manifest({"started": started})
        run.log(1, {"loss": float(started[:4])})
        project(tracking, run)
    (found,) = [r for r in shown(projected) if r.data.tags["memmlp.run_id"] == run.id]
    client = client_of(projected)
    assert [m.value for m in client.get_metric_history(found.info.run_id, "train/loss")] == [2025.0]
    client.delete_run(found.info.run_id)


def test_many_metrics_go_in_batches(projected: Path, monkeypatch: pytest.MonkeyPatch):
    from mlflow import MlflowClient

    sizes: list[tuple[int, int]] = []
    log_batch = MlflowClient.log_batch

    def spy(client: Any, run_id: str, metrics: Any = (), params: Any = (), tags: Any = ()) -> None:
        sizes.append((len(metrics), len(params)))
        log_batch(client, run_id, metrics=metrics, params=params, tags=tags)

    monkeypatch.setattr(MlflowClient, "log_batch", spy)
    run = Run.of(projected, "2" * 16)
    run.begin("memmlp", {f"key{i}": i for i in range(250)}, data="d", upstream=None)
    for step in range(600):
        run.log(step, {"a": 1.0, "b": 2.0})
    project(MLflow(None, projected), run)
    assert [size for size in sizes if size != (0, 0)] == [(0, 100), (0, 100), (0, 50), (1000, 0), (200, 0)]
    (found,) = [r for r in shown(projected) if r.data.tags["memmlp.run_id"] == run.id]
    client = client_of(projected)
    assert len(client.get_metric_history(found.info.run_id, "train/b")) == 600
    assert len(found.data.params) == 250
    client.delete_run(found.info.run_id)


def test_steps_repeated_with_other_values_replace_the_run(projected: Path):
    """MLflow can't take a value back."""
    run, tracking = a_run(projected, "3" * 16), MLflow(None, projected)
    project(tracking, run)
    run.log(5, {"loss": 77.0})
    project(tracking, run)
    (found,) = [r for r in shown(projected) if r.data.tags["memmlp.run_id"] == run.id]
    client = client_of(projected)
    history = client.get_metric_history(found.info.run_id, "train/loss")
    assert [(m.step, m.value) for m in history][-1] == (5, 77.0)
    assert len(history) == 5
    client.delete_run(found.info.run_id)


def test_a_failed_run_is_failed_and_a_killed_one_killed(projected: Path):
    tracking, client = MLflow(None, projected), client_of(projected)
    failed, killed = a_run(projected, "4" * 16), a_run(projected, "5" * 16)
    failed.fail("loss is nan at step 5")
    for run in (failed, killed):
        project(tracking, run)
    found = {run.data.tags["memmlp.run_id"]: run for run in shown(projected)}
    assert (found[failed.id].info.status, found[killed.id].info.status) == ("FAILED", "KILLED")
    assert found[failed.id].data.tags["memmlp.failure"] == "loss is nan at step 5"
    for run in (failed, killed):
        client.delete_run(found[run.id].info.run_id)


def test_the_environment_names_the_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    assert MLflow(None, tmp_path).place == f"sqlite:///{tmp_path / 'mlflow.db'}"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://somewhere")
    assert MLflow(None, tmp_path).place == "http://somewhere"
    assert MLflow("http://else", tmp_path).place == "http://else"


def test_a_server_that_is_not_there_is_an_error_that_sync_tells(tmp_path: Path):
    said: list[str] = []
    dead = MLflow("http://127.0.0.1:9", tmp_path)
    assert sync(dead, [a_run(tmp_path)], tmp_path, said.append) == {"failed": 1}
    assert said[0].startswith(f"run {'0' * 16} is not shown by mlflow: ")


def test_mlflow_says_nothing(projected: Path, capfd: pytest.CaptureFixture[str]):
    project(MLflow(None, projected), Run.of(projected, "0" * 16))
    assert capfd.readouterr() == ("", "")


COLD = """
import os, sys
from pathlib import Path
from mlflow import MlflowClient
from mlflow.store.tracking.sqlalchemy_store import SqlAlchemyStore
from memmlp.runs.run import Run
from memmlp.experiment_tracking.mlflow_logger import MLflow
from memmlp.experiment_tracking.run_logger import Session
outputs, begun = Path(sys.argv[1]), []
for name in sys.argv[2:]:
    if not (process := os.fork()):
        Session(MLflow(None, outputs), Run.of(outputs, name), outputs / "ledgers").end()
        sys.exit()
    begun.append(process)
sys.exit(sum(os.waitpid(process, 0)[1] for process in begun))
"""
"""Processes that have imported MLflow, and do not know its store yet, which is not there."""


def test_cold_starts_at_once_do_not_ruin_the_store(tmp_path: Path):
    names = [f"{i:016x}" for i in range(2)]
    for name in names:
        a_run(tmp_path, name)
    ran = finished([sys.executable, "-c", COLD, str(tmp_path), *names])
    assert (ran.returncode, ran.stderr) == (0, "")
    assert {run.data.tags["memmlp.run_id"] for run in shown(tmp_path)} == set(names)


def test_a_sweep_is_the_parent_of_its_runs_and_a_shared_run_has_one_parent(tmp_path: Path):
    tracking, (first, second) = MLflow(None, tmp_path), ("a" * 16, "b" * 16)
    for name in (first, second):
        project(tracking, a_run(tmp_path, name))
    (tmp_path / "table.md").write_text("| a table |")
    mine = SweepFacts(
        "table04", tmp_path, "done", {first: "full", second: "none"}, {"none/stream/MPJPE": 6.5},
        {"none (w/o codes)/stream/MPJPE": "holds"}, (tmp_path / "table.md",),
    )  # fmt: skip
    other = SweepFacts("table11", tmp_path, "failed", {first: "with VQ-VAE"}, {}, {}, ())
    for _ in range(2):
        tracking.sweep(mine)
        tracking.sweep(other)
    tags = ("memmlp.sweep", "memmlp.run_id")
    runs = {next(run.data.tags[key] for key in tags if key in run.data.tags): run for run in shown(tmp_path)}
    assert set(runs) == {first, second, "table04", "table11"}
    shared, own, parent = runs[first].data.tags, runs[second].data.tags, runs["table04"]
    assert shared["mlflow.parentRunId"] == own["mlflow.parentRunId"] == parent.info.run_id
    assert (shared["memmlp.arm.table04"], shared["memmlp.arm.table11"]) == ("full", "with VQ-VAE")
    assert "memmlp.arm.table11" not in own
    assert (parent.info.status, runs["table11"].info.status) == ("FINISHED", "FAILED")
    assert parent.data.metrics == {"none/stream/MPJPE": 6.5}
    key = f"verdict/{allowed('none (w/o codes)/stream/MPJPE')}"
    assert parent.data.tags[key] == "holds"
    assert [item.path for item in client_of(tmp_path).list_artifacts(parent.info.run_id)] == ["table.md"]


def test_a_mean_that_is_no_more_is_not_kept(tmp_path: Path):
    """As when an arm is renamed, or a further seed of it diverges."""
    tracking, known = MLflow(None, tmp_path), {"a/stream/MPJPE": 6.5, "b/stream/MPJPE": 5.0}
    for aggregates in (known, {"b/stream/MPJPE": 5.0}):
        tracking.sweep(SweepFacts("mine", tmp_path, "done", {}, aggregates, {}, ()))
    (found,) = (run.data.metrics for run in shown(tmp_path))
    assert math.isnan(found.pop("a/stream/MPJPE"))
    assert found == {"b/stream/MPJPE": 5.0}
    tracking.sweep(SweepFacts("mine", tmp_path, "done", {}, known, {}, ()))
    assert [run.data.metrics for run in shown(tmp_path)] == [known]


def test_names_that_mlflow_does_not_allow_stay_different():
    assert allowed("stream/MPJPE cm") == "stream/MPJPE cm"
    assert len({allowed("a,b"), allowed("a;b"), "a_b"}) == 3


def test_packages_are_as_talkative_afterwards_as_before(tmp_path: Path):
    logger = logging.getLogger("alembic")
    for level in (logging.INFO, logging.ERROR):
        logger.setLevel(level)
        project(MLflow(None, tmp_path), a_run(tmp_path))
        assert logger.level == level
