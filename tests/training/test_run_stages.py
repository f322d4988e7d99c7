"""The whole way at profile=tiny, by the commands a person would type."""

import importlib
import json
import shutil
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from begun_runs import begun
from command_line import TINY
from command_line import run as command
from conftest import INT8
from own_package import registers_kept
from PIL import Image

from memmlp.common.errors import InputError, LeaseLost, TrainingDiverged
from memmlp.common.files import file_digest
from memmlp.config.build import build_experiment
from memmlp.config.compose import compose_config
from memmlp.motion.dataset import MotionDataset
from memmlp.report.tables.measured_run import load_measured_run
from memmlp.runs import environment
from memmlp.runs.evaluation_file import write_report
from memmlp.runs.identity import VERSIONS
from memmlp.runs.lookup import list_runs
from memmlp.runs.run import Run
from memmlp.sweep.worker import Cancelled
from memmlp.training import run_stages
from memmlp.training.run_stages import record_outcome


def motion_run(folder: Path) -> Run:
    """Return the run that was there at first."""
    return [run for run in list_runs(folder / "outputs") if run.manifest["kind"] == "memmlp"][-1]


def stages(run: Run) -> list[str]:
    return [path.stem for path in (*run.evaluations.iterdir(), *run.deployments.iterdir())]


def test_a_run_leaves_everything(home):
    run = motion_run(home)
    assert run.done
    assert run.verify() == []
    for name in ("config.yaml", "manifest.json", "metrics.jsonl", "checkpoint.safetensors"):
        assert (run.folder / name).stat().st_size > 0
    assert run.preferred_deployment.done
    assert set(run.requested_stages) == set(stages(run))
    assert set(run.results) == {"window", "stream", "latency"}
    assert {run.manifest[fact] for fact in ("partial", "divided", "resampled", "unusual")} == {None}
    assert run.results["stream"]["rotation"]["MPJPE"] > 0
    assert run.results["latency"]["steps"] >= 200
    assert run.results["latency"]["onnx_parity"] < 1e-4
    prerequisite = Run.from_id(home / "outputs", run.manifest["prerequisite"])
    assert prerequisite.done
    assert prerequisite.manifest["kind"] == "vqvae"
    (known,) = run.manifest["prerequisite_runs"]
    assert (known["id"], known["weights"]) == (prerequisite.id, file_digest(prerequisite.model))
    assert known["component_versions"] == prerequisite.manifest["component_versions"]
    assert load_measured_run(run.folder).origin.prerequisite_versions["vqvae"] == VERSIONS["vqvae"]
    with Image.open(run.folder / "poses.png") as picture:
        assert picture.size[0] > 600
        assert len(picture.convert("RGB").getcolors(10**6)) > 50
    report = json.loads(next(run.evaluations.glob("stream-*.json")).read_text())
    assert report["run"] == run.id
    assert report["component_versions"] == {name: VERSIONS[name] for name in ("metrics", "mode.stream")}
    versions = run.manifest["component_versions"] | report["component_versions"]
    assert load_measured_run(run.folder).origin.component_versions.items() >= versions.items()
    graph = onnx.load(run.preferred_onnx)
    assert {p.key: p.value for p in graph.metadata_props}["run_id"] == run.id
    out = (home / "out.txt").read_text()
    assert "MPJPE" in out
    assert str(run.folder.relative_to(home)) in out


def test_data_without_test_clips_is_refused_before_the_training(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    experiment = build_experiment(compose_config([*TINY, "memory=none", "data.split.test=0"]))
    with pytest.raises(InputError, match="no test clips"):
        run_stages.run_experiment(experiment)
    assert not list_runs(tmp_path / "outputs")


def test_eval_repeats_the_runs_numbers_and_saves_predictions(home):
    run = motion_run(home)
    first = next(r for r in list_runs(home / "outputs") if "window" in r.results)
    said = command(home, "eval", first.id[:6], "--json", "found.json")
    assert "measured before" in said
    words = ("--again", "--save-predictions", "predictions", "--json", "again.json")
    assert "evaluation done" in command(home, "eval", first.id[:6], *words)
    again = json.loads((home / "again.json").read_text())
    for branch, values in again["mean"]["stream"].items():
        assert values == pytest.approx(first.results["stream"][branch], rel=1e-4)
    row = again["clips"][0]
    with np.load(home / "predictions" / "stream" / f"{row['name']}.npz", allow_pickle=False) as file:
        arrays = dict(file)
    assert arrays["predicted_positions"].shape == (row["frames"], 22, 3)
    assert arrays["predicted_rotations"].shape == (row["frames"], 22, 3, 3)
    error = 100 * np.linalg.norm(arrays["predicted_positions"] - arrays["true_positions"], axis=-1).mean()
    assert error == pytest.approx(row["stream"]["rotation"]["MPJPE"], rel=1e-4)
    head = arrays["predicted_positions"][:, 15] - arrays["true_positions"][:, 15]
    assert np.abs(head).max() < 1e-5
    assert run.done


def test_a_mode_a_solver_or_a_precision_is_that_stages_work_alone(home, monkeypatch):
    """A trained run takes not one step more, and its own results stay what they were."""
    run = motion_run(home)
    weights, log, results = run.model.read_bytes(), run.metrics_path.read_bytes(), run.results
    count = len(stages(run))
    ik = ("evaluation.ik=lbfgs", "evaluation.ik_iterations=1")
    assert "evaluation done" in command(home, "eval", run.id, *ik)
    assert "finished already" in command(home, "train", *TINY, INT8, *ik)
    with monkeypatch.context() as patch:  # the same graph as that of int8
        patch.setattr(
            "memmlp.deploy.export.export", lambda model, path, *_: shutil.copy(run.preferred_onnx, path)
        )
        said = command(home, "eval", run.id, "export.precision=fp32")
    assert "deployment done" in said
    assert "evaluation" not in said
    both = ("memory.blend=1", "export.precision=fp32", "export.graph=naive")
    assert "evaluation and deployment done" in command(home, "eval", run.id, *both)
    assert "measured before" in command(home, "eval", run.id, "evaluation.ik=off", INT8)
    assert "would change the training" in command(home, "eval", run.id, "memory.shift=frame", code=2)
    assert "evaluation.ik" in command(home, "eval", run.id, "evaluation.ik=[", code=2)
    assert "evaluation.ik=guess" in command(home, "eval", run.id, "evaluation.ik=guess", code=2)
    assert (run.model.read_bytes(), run.metrics_path.read_bytes()) == (weights, log)
    now = Run(run.folder).results
    assert set(now["stream"]) == {*results["stream"], "combined"}
    assert now["stream"]["rotation"] == results["stream"]["rotation"]  # of m = 0.5, and not of the last one
    assert len(stages(run)) == count + 2 + 1 + 3


def test_a_nan_is_not_exported(home, memmlp, monkeypatch):
    monkeypatch.chdir(home)
    apart = torch.tensor([1e-6, float("nan")])
    monkeypatch.setattr("memmlp.deploy.parity.measure_differences", lambda *_: apart)
    monkeypatch.setattr("memmlp.deploy.export.export", lambda model, path, run, opset: path.write_bytes(b""))
    monkeypatch.setattr(MotionDataset, "read_clips", lambda self: [torch.zeros(2, 252)])
    ran = memmlp("export", motion_run(home).id, "--out", "never.onnx", "--opset", "17")
    assert (ran.code, "not written" in ran.err) == (1, True)
    assert not list(home.glob("*never*")) + list(home.glob(".export-*"))


def test_changed_weights_are_not_evaluated_and_what_is_exported_is_checked_on_the_runs_data(home, tmp_path):
    copy = Run(shutil.copytree(motion_run(home).folder, tmp_path / "best"))
    words = ("--out", "other.onnx", "--opset", "17")
    data = copy.manifest["data"]
    copy.write_manifest({"data": "0" * 64})
    assert "its data has changed since" in command(home, "export", str(copy.folder), *words, code=2)
    copy.write_manifest({"data": data})
    weights = bytearray(copy.model.read_bytes())
    weights[-1] ^= 1
    copy.model.write_bytes(weights)
    assert "changed since the training" in command(home, "eval", str(copy.folder), "--again", code=2)


@pytest.mark.parametrize(("error", "failure"), [
    (TrainingDiverged("loss is nan"), "loss is nan"), (OSError(5, "bad disk"), "bad disk"),
    (OSError(28, "disk full"), None), (BrokenPipeError(32, "nobody reads"), None),
    (LeaseLost("taken over"), None), (InputError("data changed"), None),
    (Cancelled("by its plan"), None), (KeyboardInterrupt(), None), (RuntimeError("no export"), None),
])  # fmt: skip
def test_a_failure_of_the_work_is_kept_with_the_run_and_an_interruption_is_not(tmp_path, error, failure):
    run = begun(tmp_path)
    experiment: Any = SimpleNamespace(loggers=(), stage_ids=(), outputs=tmp_path)
    if type(error) is RuntimeError:
        error.__context__ = KeyboardInterrupt()
    with pytest.raises(type(error)), record_outcome(experiment, run):
        raise error
    assert (run.failure is None) == (failure is None)
    assert (failure or "") in (run.failure or "")


def test_metrics_of_other_code_are_measured_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Users' packages, whose code is in the report; without them no package has to do with the errors."""
    code, run = tmp_path / "mine.py", Run(tmp_path / "run")
    monkeypatch.syspath_prepend(tmp_path)
    code.write_text("A = 1\n")
    with registers_kept():
        importlib.import_module("mine")
        evaluations = {"stream": "stream-0", "window": "window-0"}
        experiment: Any = SimpleNamespace(config={"plugins": ["mine"]}, evaluations=evaluations)
        made = {"mean": {}, "clips": [], **run_stages.describe_user_code(experiment)}
        missing = partial(run_stages.list_missing_modes, experiment, run)
        own = made | {"mode": "stream", "settings": {"metrics": {"a": "mine.a"}}}
        write_report(run.evaluation("stream-0"), own)
        assert missing() == ["window"]
        write_report(run.evaluation("window-0"), made | {"mode": "window", "settings": {}})
        assert missing() == []
        code.write_text("A = 2\n")
        assert missing() == []  # this process would measure them as before
        environment._read_user_code.cache_clear()
        assert missing() == ["stream"]
