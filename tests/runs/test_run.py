"""Run folders: what a kill at any moment leaves."""

import math
import shutil
from pathlib import Path

import pytest
from begun_runs import CONFIG, begun, complete

import memmlp.runs.identity
from memmlp.common.errors import InputError
from memmlp.common.files import write_json
from memmlp.report.tables.measured_run import load_measured_run
from memmlp.report.ui.run_index import read_facts
from memmlp.runs import identity
from memmlp.runs.evaluation_file import is_intact, write_report
from memmlp.runs.query import build_record
from memmlp.runs.run import Run


def test_a_run_is_done_when_its_marker_is_whole(tmp_path: Path):
    run = begun(tmp_path)
    with pytest.raises(FileNotFoundError):
        run.finish(["results.json"])
    write_json(run.results_path, {})
    assert not run.done
    run.finish(["results.json"])
    assert run.done
    assert run.manifest["finished"] >= run.manifest["started"]
    content = run.marker.read_bytes()
    for cut in range(len(content) - 2):
        run.marker.write_bytes(content[:cut])
        assert not run.done


def test_a_folder_under_anothers_id_is_no_run(tmp_path: Path):
    """Its numbers would stand for a training that never was. A copy of another name is one."""
    run = complete(tmp_path)
    other = Run.from_id(tmp_path, "0123456789abcdef")
    shutil.copytree(run.folder, other.folder)
    copy = Run(shutil.copytree(run.folder, tmp_path / "best"))
    assert (run.done, other.done, copy.done) == (True, False, True)
    assert (run.has("int8-0"), other.has("int8-0"), copy.has("int8-0")) == (True, False, True)


def test_an_evaluation_of_another_run_or_name_is_refused(tmp_path: Path):
    run, other = complete(tmp_path), complete(tmp_path, CONFIG | {"seed": 1})
    for holder, name in ((run, "stream-1"), (other, "stream-0")):
        shutil.copy(run.evaluation("stream-0"), holder.evaluation(name))
        load_measured_run(run.folder, ["stream-0"])
        with pytest.raises(InputError, match=rf"evaluations/{name}\.json: changed since"):
            load_measured_run(holder.folder, [name])
        assert holder.verify() == [f"evaluations/{name}.json"]


def test_changed_weights_and_deployments_are_refused_and_lost_ones_are_made_again(tmp_path: Path):
    run = complete(tmp_path)
    place = run.deployment("int8-0")
    assert (run.preferred_onnx, run.weights()) == (place.int8, run.model)
    place.int8.write_bytes(b"another network's")
    with pytest.raises(InputError, match=r"int8\.onnx: changed since it was exported"):
        _ = run.preferred_onnx
    place.int8.unlink()
    assert not run.has("int8-0")
    assert run.preferred_onnx != place.onnx  # which would be used in its place in silence
    run.model.write_bytes(b"other")
    with pytest.raises(InputError, match="changed since the training"):
        run.weights()


def deploy(run: Run, made: str, measured: dict, **export) -> None:
    """Add a deployment with those settings of `export`, made at that time."""
    settings = identity.select_deployment_settings(
        {"export": {"graph": "auto", "precision": "fp32", **export}}
    )
    place = run.deployment(identity.hash_deployment_settings(settings))
    place.folder.mkdir(parents=True)
    write_json(
        place.latency, {"run": run.id, "settings": settings, "made": made, "artifacts": {}, **measured}
    )


INTEGERS = {"median_ms": 1.0, "onnx_bytes": 15, "int8": {"median_ms": 0.4, "onnx_bytes": 4}}


@pytest.mark.parametrize("graph", ["auto", "off"])
def test_times_shown_are_of_the_file_that_the_config_asks_for(tmp_path: Path, graph: str):
    run = begun(tmp_path, CONFIG | {"export": {"graph": graph, "precision": "fp32"}})
    deploy(run, "2026-01-01", {"median_ms": 1.0, "onnx_bytes": 15})
    deploy(run, "2026-01-02", INTEGERS, precision="int8")
    deploy(run, "2026-01-03", {"median_ms": 5.0, "onnx_bytes": 14}, graph="naive")
    one = build_record(run)
    assert (one["latency.median_ms"], one["latency.onnx_bytes"]) == (1.0, 15)
    assert not [key for key in one if key.startswith("latency-")]
    assert load_measured_run(run.folder).costs["ms"] == 1.0
    assert read_facts(run.folder)["metrics"]["latency.median_ms"] == 1.0
    assert run.preferred_deployment.settings["graph"] == "auto"


def test_todays_recipes_come_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    run, versions = begun(tmp_path), memmlp.runs.identity.VERSIONS
    int8, fp32 = ({"export": {"graph": "naive", "precision": p}, "evaluation": {}} for p in ("int8", "fp32"))

    def make(config: dict, value: float, graph: bytes) -> None:
        settings = identity.select_evaluation_settings(config, "stream")
        report = {"mode": "stream", "settings": settings, "mean": {"rotation": {"MPJPE": value}}, "clips": []}
        write_report(run.evaluation(identity.compute_evaluation_id(config, "stream")), report)
        place = run.deployment(identity.compute_deployment_id(config))
        place.folder.mkdir(parents=True)
        for path in (place.onnx, *([place.int8] if graph == b"old" else [])):
            path.write_bytes(graph)
        accurate = {"growth": 0.0, "jitter_growth": 0.0}
        place.finish({"settings": identity.select_deployment_settings(config), "int8": accurate})

    newer = {name: versions[name] + 1 for name in ("metrics", "graph.naive")}
    with monkeypatch.context() as today:
        for name, version in newer.items():
            today.setitem(versions, name, version)
        make(fp32, 2.0, b"new")
    make(int8, 1.0, b"old")
    assert run.results["stream"]["rotation"]["MPJPE"] == 1.0
    for name, version in newer.items():
        monkeypatch.setitem(versions, name, version)
    assert run.results["stream"]["rotation"]["MPJPE"] == 2.0
    assert load_measured_run(run.folder).means["stream"]["rotation"]["MPJPE"] == 2.0
    assert run.preferred_onnx.read_bytes() == b"new"


def test_verify_names_what_changed(tmp_path: Path):
    run, names = begun(tmp_path), ["clips.json", "latency.json", "results.json"]
    for name in names:
        write_json(run.folder / name, {})
    run.finish(names)
    place, report = run.deployment("fp32-0"), run.evaluation("stream-0")
    place.folder.mkdir(parents=True)
    place.onnx.write_bytes(b"graph")
    place.finish({})
    write_report(report, {"mode": "stream", "mean": {"rotation": {"MPJPE": math.nan}}, "clips": []})
    assert is_intact(report)
    assert run.verify() == []
    (run.folder / "clips.json").write_text("{ }")
    (run.folder / "latency.json").unlink()
    place.onnx.write_bytes(b"other")
    report.write_text(report.read_text().replace("nan", "0.1"))
    assert run.verify() == [*names[:2], "deployments/fp32-0/step.onnx", "evaluations/stream-0.json"]


def test_a_reset_removes_the_runs_files_and_no_others_results_first(tmp_path: Path, monkeypatch):
    """At any moment, what is removed first is what was made from the rest."""
    run = begun(tmp_path)
    for name in Run.FILES:
        path = run.folder / name.replace("*", "0")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text('{"any": 1}')
    for name in (".checkpoint.safetensors.123.tmp", "notes.txt"):
        (run.folder / name).touch()
    run.finish([])
    unlink, left, removed = Path.unlink, [], []

    def spy(path: Path, missing_ok: bool = False) -> None:
        removed.append(path.name)
        unlink(path, missing_ok=missing_ok)
        results = [run.checkpoint, run.model, *run.folder.glob("[ed]*s/**/*.*")]
        left.append((run.manifest_path.exists(), any(one.exists() for one in results)))

    monkeypatch.setattr(Path, "unlink", spy)
    run.reset()
    assert removed[0] == "DONE"
    assert (False, True) not in left
    assert left[-1] == (False, False)
    assert [path.name for path in run.folder.iterdir()] == ["notes.txt"]


def test_a_resumed_run_keeps_its_start(tmp_path: Path):
    run = begun(tmp_path)
    run.write_manifest({"started": "2020-01-01T00:00:00+00:00", "finished": "2020-01-02"})
    begun(tmp_path)
    assert run.manifest["started"].startswith("2020")
    assert run.manifest["finished"] is None
    assert run.config == CONFIG


def test_the_status_names_the_stage_that_somebody_is_at(tmp_path: Path):
    run = begun(tmp_path)
    with run.lock():
        assert run.status == "training"
        write_json(run.results_path, {})
        run.finish(["results.json"])
        assert run.status == "done"  # somebody holds it who works on no later stage of it
        for stage, word in (("evaluation", "evaluating"), ("deployment", "exporting")):
            run.attempt(stage)
            assert (run.activity, run.status, run.state(False)) == (word, word, "running")
    assert (run.activity, run.status) == (None, "done")
    run.fail("the evaluation's memory")
    assert (run.status, run.done) == ("failed", True)


def test_a_run_that_was_killed_before_its_evaluation_is_trained_and_not_done(tmp_path: Path):
    run = begun(tmp_path, CONFIG | {"evaluation": {"modes": ["window", "stream"]}})
    run.model.write_bytes(b"weights")
    run.finish(["model.safetensors"])
    run.evaluations.mkdir()
    run.request_stages(["window-0", "stream-0"])
    for name, status in (("stream-0", "trained"), ("window-0", "done")):
        write_report(run.evaluation(name), {"mode": name[:6], "mean": {}, "clips": []})
        assert run.status == status
    run.request_stages(["window-0", "stream-1"])
    with run.lock():
        assert run.status == "trained"  # somebody holds it, at none of its stages
    assert run.status == "trained"
    run.request_stages(["window-0", "stream-0"])
    assert run.status == "done"


def test_a_damaged_manifest_is_not_replaced(tmp_path: Path):
    run = begun(tmp_path)
    run.manifest_path.write_bytes(content := run.manifest_path.read_bytes()[:-2])
    for write in (lambda: run.record_seconds("training", 1.0), lambda: run.attempt("training")):
        with pytest.raises(InputError, match=r"manifest\.json: cannot be read"):
            write()
    assert run.manifest_path.read_bytes() == content
