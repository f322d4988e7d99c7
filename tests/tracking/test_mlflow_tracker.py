"""MLflow shows what the run folder holds, can be asked twice, and never harms a run."""

from __future__ import annotations

import logging
import math
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from memmlp.cli.mlflow_commands import track
from memmlp.runs.mlflow_tracking import MLflowTracking, NoTracking, project_safely
from processes import finished

from memmlp.common.files import write_json
from memmlp.runs.run import Run
from memmlp.sweep.plan import Entry, Plan

pytestmark = pytest.mark.slow

CONFIG = {"seed": 0, "memory": {"layers": [2, 4], "shift": None}, "long": "x" * 7000}


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


def client_of(outputs: Path) -> Any:
    from mlflow import MlflowClient

    return MlflowClient(f"sqlite:///{outputs / 'mlflow.db'}")


def shown(outputs: Path) -> list[Any]:
    client = client_of(outputs)
    return client.search_runs([client.get_experiment_by_name("memmlp").experiment_id])


def steps(outputs: Path, key: str) -> list[tuple[int, float]]:
    (run,) = shown(outputs)
    return [(m.step, m.value) for m in client_of(outputs).get_metric_history(run.info.run_id, key)]


@pytest.fixture(scope="module")
def projected(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An outputs folder with one run, projected when unfinished, when longer, and when done, twice."""
    outputs = tmp_path_factory.mktemp("outputs")
    tracking, run = MLflowTracking(None, outputs), a_run(outputs)
    tracking.project(run)
    run.begin("memmlp", CONFIG | {"seed": 0.5}, data="d", upstream="u")  # resumed with other settings
    time.sleep(0.01)
    run.log(5, {"loss": 1 / 5})  # repeated
    run.log(6, {"loss": 0.1, "new": 1.0})
    tracking.project(run)
    run.finish(["results.json"])
    tracking.project(run)
    tracking.project(run)
    return outputs


def test_one_run_however_often_it_is_projected(projected: Path):
    (run,) = shown(projected)
    assert run.info.status == "FINISHED"
    assert run.data.tags["memmlp.run_id"] == run.info.run_name == "0" * 16
    assert run.data.tags["memmlp.upstream"] == "u"


def test_no_step_twice(projected: Path):
    expected = [(step, 1 / step) for step in range(1, 6)] + [(6, 0.1)]
    assert steps(projected, "train/loss") == expected
    assert steps(projected, "train/new") == [(6, 1.0)]
    assert [math.isnan(value) for _, value in steps(projected, "train/bad")] == [True] * 5


def test_params_and_results(projected: Path):
    (run,) = shown(projected)
    assert run.data.params == {
        "seed": "0",
        "memory.layers": "[2, 4]",
        "memory.shift": "None",
        "long": "x" * 6000,
    }
    assert run.data.metrics["stream/rotation/MPJPE"] == 6.5
    assert "note" not in run.data.metrics


def test_small_artifacts_lie_in_the_outputs(projected: Path):
    (run,) = shown(projected)
    names = {item.path for item in client_of(projected).list_artifacts(run.info.run_id)}
    assert names == {"config.yaml", "results.json", "step.onnx", "latency.json"}
    assert (projected / "mlflow-artifacts").is_dir()


def test_a_run_done_again_replaces_the_old_one(projected: Path):
    run = Run.of(projected, "1" * 16)
    tracking = MLflowTracking(None, projected)
    for started in ("2024-01-01T00:00:00+00:00", "2025-01-01T00:00:00+00:00"):
        run.reset()
        run.begin("memmlp", CONFIG, data="d", upstream=None)
        run.write_manifest({"started": started})
        run.log(1, {"loss": float(started[:4])})
        tracking.project(run)
    (found,) = [r for r in shown(projected) if r.data.tags["memmlp.run_id"] == run.id]
    client = client_of(projected)
    assert [m.value for m in client.get_metric_history(found.info.run_id, "train/loss")] == [2025.0]
    client.delete_run(found.info.run_id)


def test_many_metrics_go_in_batches(projected: Path, monkeypatch: pytest.MonkeyPatch):
    from mlflow import MlflowClient

    sizes: list[tuple[int, int]] = []
    log_batch = MlflowClient.log_batch

    def spy(client: Any, run_id: str, metrics: Any = (), params: Any = ()) -> None:
        sizes.append((len(metrics), len(params)))
        log_batch(client, run_id, metrics=metrics, params=params)

    monkeypatch.setattr(MlflowClient, "log_batch", spy)
    run = Run.of(projected, "2" * 16)
    run.begin("memmlp", {f"key{i}": i for i in range(250)}, data="d", upstream=None)
    for step in range(600):
        run.log(step, {"a": 1.0, "b": 2.0})
    MLflowTracking(None, projected).project(run)
    assert sizes == [(0, 100), (0, 100), (0, 50), (1000, 0), (200, 0)]
    (found,) = [r for r in shown(projected) if r.data.tags["memmlp.run_id"] == run.id]
    client = client_of(projected)
    assert len(client.get_metric_history(found.info.run_id, "train/b")) == 600
    assert len(found.data.params) == 250
    client.delete_run(found.info.run_id)


def test_the_environment_names_the_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    tracking = MLflowTracking(None, tmp_path)
    assert tracking.store() == f"sqlite:///{tmp_path / 'mlflow.db'}"
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://somewhere")
    assert tracking.store() == "http://somewhere"
    assert MLflowTracking("http://else", tmp_path).store() == "http://else"


def test_a_failure_is_one_line_and_no_more(tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    run = a_run(tmp_path)
    project_safely(MLflowTracking("http://127.0.0.1:9", tmp_path), run)
    out, err = capfd.readouterr()
    assert out == ""
    assert err.startswith(f"memmlp: warning: run {run.id} is not shown by the tracking: ")
    assert err.count("\n") == 1


def test_mlflow_says_nothing(projected: Path, capfd: pytest.CaptureFixture[str]):
    MLflowTracking(None, projected).project(Run.of(projected, "0" * 16))
    assert capfd.readouterr() == ("", "")


COLD = "import sys; from pathlib import Path; from memmlp.runs.run import Run; " \
    "from memmlp.runs.mlflow_tracking import *; " \
    "MLflowTracking(None, Path(sys.argv[1])).project(Run.of(sys.argv[1], sys.argv[2]))"  # fmt: skip


@pytest.mark.slow
def test_cold_starts_at_once_do_not_ruin_the_store(tmp_path: Path):
    names = [f"{i:016x}" for i in range(2)]
    for name in names:
        a_run(tmp_path, name)
    with ThreadPoolExecutor(2) as pool:
        jobs = pool.map(
            lambda name: finished([sys.executable, "-c", COLD, str(tmp_path), name]),
            names,
        )
    assert [(job.returncode, job.stderr) for job in jobs] == [(0, "")] * 2
    assert {run.info.run_name for run in shown(tmp_path)} == set(names)


BLOCKED = """
import sys
sys.modules["mlflow"] = None
from pathlib import Path
from memmlp.runs.run import Run
from memmlp.runs.mlflow_tracking import MLflowTracking, NoTracking, project_safely
run = Run.of(sys.argv[1], "0" * 16)
project_safely(NoTracking(), run)
print("none works")
project_safely(MLflowTracking(None, Path(sys.argv[1])), run)
"""


def test_no_tracking_needs_no_mlflow(tmp_path: Path):
    a_run(tmp_path)
    job = finished([sys.executable, "-c", BLOCKED, str(tmp_path)])
    assert (job.returncode, job.stdout) == (0, "none works\n")
    assert job.stderr.count("\n") == 1
    assert "mlflow" in job.stderr


def test_no_tracking_leaves_nothing(tmp_path: Path):
    NoTracking().project(a_run(tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]


def test_a_sweep_is_the_parent_of_its_runs_and_a_shared_run_has_one_parent(tmp_path: Path):
    tracking = MLflowTracking(None, tmp_path)
    for name in ("a" * 16, "b" * 16):
        tracking.project(a_run(tmp_path, name))
    for _ in range(2):
        tracking.group("table04", {"a" * 16: "full", "b" * 16: "none"})
        tracking.group("table11", {"a" * 16: "with VQ-VAE"})
    runs = {run.info.run_name: run for run in shown(tmp_path)}
    assert set(runs) == {"a" * 16, "b" * 16, "table04", "table11"}
    shared, other = runs["a" * 16].data.tags, runs["b" * 16].data.tags
    assert shared["mlflow.parentRunId"] == other["mlflow.parentRunId"] == runs["table04"].info.run_id
    assert (shared["memmlp.arm.table04"], shared["memmlp.arm.table11"]) == ("full", "with VQ-VAE")
    assert "memmlp.arm.table11" not in other


def test_sync_rebuilds_the_view_and_changes_nothing_the_second_time(tmp_path: Path):
    run = a_run(tmp_path)
    run.finish(["results.json"])
    Plan("mine", tmp_path, (Entry("full", 0, run.id),), ()).save(tmp_path / "sweeps" / "mine" / "plan.json")
    views = []
    for _ in range(2):
        said = CliRunner().invoke(track, ["sync", "--outputs", str(tmp_path)])
        assert said.exit_code == 0, said.output
        assert "1 runs and 1 sweeps" in said.output
        views.append(
            sorted((r.info.run_name, len(r.data.metrics), len(r.data.tags)) for r in shown(tmp_path))
        )
    assert views[0] == views[1]
    assert [name for name, *_ in views[0]] == ["0" * 16, "mine"]


def test_packages_are_as_talkative_afterwards_as_before(tmp_path: Path):
    logger = logging.getLogger("alembic")
    for level in (logging.INFO, logging.ERROR):
        logger.setLevel(level)
        MLflowTracking(None, tmp_path).project(a_run(tmp_path))
        assert logger.level == level
