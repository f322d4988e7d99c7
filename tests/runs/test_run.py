"""Run folders: what counts for an identity, and what a kill at any moment leaves."""

from __future__ import annotations

import contextlib
import json
import math
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from processes import finished, started

import memmlp.runs.recipes
from memmlp.common.errors import InputError
from memmlp.common.files import atomic_write, write_json
from memmlp.runs.environment import environment
from memmlp.runs.evaluation_file import intact, write_report
from memmlp.runs.identity import (
    NEUTRAL,
    Identity,
    deployment_id,
    deployment_settings,
    evaluation_id,
    evaluation_settings,
    flatten,
    run_id,
)
from memmlp.runs.lookup import diff, find_run, list_runs
from memmlp.runs.run import Run
from memmlp.tables.measured_run import load

CONFIG = {"seed": 0, "model": {"width": 16, "layers": [2, 4]}, "optim": {"lr": 1e-3, "log_every": 5}}


def identity(config: dict = CONFIG, kind: str = "memmlp", data: str = "d", upstream: str | None = "u") -> str:
    return run_id(kind, config, data=data, upstream=upstream)


def begun(outputs: Path, config: dict = CONFIG, kind: str = "memmlp") -> Run:
    run = Run.of(outputs, identity(config, kind))
    run.begin(kind, config, data="d", upstream=None)
    return run


def test_identity_is_sixteen_hex_digits_that_never_change():
    assert identity() == "52c6c5239e75f155"


@pytest.mark.parametrize(
    "other",
    [
        {"config": CONFIG | {"seed": 1}},
        {"config": CONFIG | {"model": {"width": 16, "layers": [4, 2]}}},
        {"config": CONFIG | {"new": 0}},
        {"kind": "vqvae"},
        {"data": "e"},
        {"upstream": None},
    ],
)
def test_what_changes_the_result_changes_the_identity(other: dict):
    assert identity(**other) != identity()


def test_a_components_recipe_moves_the_runs_that_use_it_and_no_others(monkeypatch: pytest.MonkeyPatch):
    gru, lstm = ({**CONFIG, "memory": {"name": name}} for name in ("gru", "lstm"))
    before = identity(gru), identity(lstm)
    monkeypatch.setitem(memmlp.runs.recipes.RECIPES, "memory.gru", 2)
    assert identity(gru) != before[0]
    assert identity(lstm) == before[1]


def test_what_a_run_is_does_not_move_with_recipes(monkeypatch: pytest.MonkeyPatch):
    config = {**CONFIG, "memory": {"name": "gru"}}
    codes = Identity("vqvae", {"vqvae": {"codebook": "ema"}}, "d")
    own = Identity("memmlp", config, "d", codes)
    what, before = own.what, own.id
    monkeypatch.setitem(memmlp.runs.recipes.RECIPES, "vqvae", 2)
    assert own.id != before  # by its VQ-VAE's
    assert own.what == what
    assert Identity("memmlp", config, "e", codes).what != what


def test_where_a_class_lies_does_not_count():
    def of(path: str) -> str:
        return identity({**CONFIG, "memory": {"name": "gru", "_target_": path}})

    assert of("memmlp.a.B") == of("memmlp.c.d.B")
    assert len({of("memmlp.a.B"), of("mine.B"), of("theirs.B")}) == 3  # a name alone tells no foreign class


def test_stages_have_identities_of_what_changes_them_alone():
    def of(**changes: object) -> tuple[str, str, str]:
        config = {**CONFIG, "evaluation": {"ik": "off", "ik_iterations": 15, "batch": 4}, "export": {"a": 1}}
        for key, value in changes.items():
            group, name = key.split("__")
            config[group] = {**config.get(group, {}), name: value}
        return identity(config), evaluation_id(config, "stream"), deployment_id(config)

    def moved(**changes: object) -> list[bool]:
        return [a != b for a, b in zip(of(), of(**changes), strict=True)]

    assert moved(evaluation__ik="lbfgs") == [False, True, False]
    assert moved(evaluation__ik_iterations=3) == [False, False, False]  # there is no inverse kinematics
    assert moved(evaluation__batch=1) == [False, False, False]
    assert moved(export__a=2) == [False, False, True]
    assert moved(optim__lr=1) == [True, False, False]
    assert moved(memory__blend=1) == [False, True, True]
    rolled = {"rollout": {"name": "own_predictions"}, "memory": {"blend": 1}}
    assert identity(CONFIG | rolled) != identity(CONFIG | {**rolled, "memory": {"blend": 0}})


@pytest.mark.parametrize("key", NEUTRAL)
def test_what_cannot_change_the_result_does_not(key: str):
    tree: object = "anything"
    for name in reversed(key.split(".")[1:]):
        tree = {name: tree}
    top = key.split(".")[0]
    merged = CONFIG | {top: {**CONFIG.get(top, {}), **tree} if isinstance(tree, dict) else tree}
    if key == "data":
        merged = CONFIG | {"data": {"root": "elsewhere"}}
        assert identity(merged) == identity(CONFIG | {"data": {"root": "here"}})
        return
    assert identity(merged) == identity()


def test_a_key_that_begins_like_an_ignored_one_counts():
    assert identity(CONFIG | {"database": 1}) != identity()


def test_equal_numbers_and_orders_are_one_identity():
    same = {"optim": {"log_every": 5, "lr": 0.001}, "model": {"layers": (2.0, 4), "width": 16.0}, "seed": 0}
    assert identity(same) == identity()


def test_metrics_survive_a_torn_line_and_a_repeated_step(tmp_path: Path):
    run = begun(tmp_path)
    run.log(1, {"loss": 3.0})
    run.log(2, {"loss": 2.0})
    run.log(2, {"loss": 2.5}, phase="val")
    with open(run.metrics_path, "ab") as file:
        file.write(b'{"step": 3, "phase": "tr')
    assert [entry.step for entry in run.metrics()] == [1, 2, 2]
    resumed = Run(run.folder)
    resumed.log(2, {"loss": 1.0})
    resumed.log(3, {"loss": 0.5})
    assert [(e.phase, e.step, e.values["loss"]) for e in resumed.metrics()] == [
        ("train", 1, 3.0), ("train", 2, 1.0), ("val", 2, 2.5), ("train", 3, 0.5),
    ]  # fmt: skip


def test_every_cut_of_the_log_is_repaired(tmp_path: Path):
    run = begun(tmp_path)
    run.log(1, {"loss": 1.0})
    run.log(2, {"loss": 2.0})
    content = run.metrics_path.read_bytes()
    first = content.index(b"\n") + 1
    for cut in range(len(content) + 1):
        run.metrics_path.write_bytes(content[:cut])
        Run(run.folder).log(9, {"loss": 9.0})
        expected = [1] * (cut >= first) + [2] * (cut == len(content)) + [9]
        assert [entry.step for entry in run.metrics()] == expected


def test_a_broken_line_inside_the_log_is_named(tmp_path: Path):
    run = begun(tmp_path)
    run.metrics_path.write_text('{"step": 1}\n')
    with pytest.raises(InputError, match=r"metrics\.jsonl: line 1"):
        run.metrics()


def test_values_that_are_no_numbers_stay_json(tmp_path: Path):
    run = begun(tmp_path)
    run.log(1, {"nan": math.nan, "inf": -math.inf})
    json.loads(run.metrics_path.read_text(), parse_constant=pytest.fail)
    values = run.metrics()[0].values
    assert math.isnan(values["nan"])
    assert values["inf"] == -math.inf
    write_json(run.results_path, {"a": [math.nan]})
    assert run.results == {"a": ["nan"]}


def test_a_run_is_done_when_its_marker_is_whole(tmp_path: Path):
    run = begun(tmp_path)
    write_json(run.results_path, {})
    assert not run.done
    run.finish(["results.json"])
    assert run.done
    assert run.manifest["finished"] >= run.manifest["started"]
    content = run.marker.read_bytes()
    for cut in range(len(content) - 2):
        run.marker.write_bytes(content[:cut])
        assert not run.done


def complete(outputs: Path, config: dict = CONFIG) -> Run:
    """A run with weights, an evaluation and a deployment in int8."""
    run = begun(outputs, config)
    run.model.write_bytes(b"weights")
    run.finish(["model.safetensors"])
    report = {"mode": "stream", "run": run.id, "name": "stream-0", "mean": {}, "clips": []}
    write_report(run.evaluation("stream-0"), report)
    place = run.deployment("int8-0")
    place.folder.mkdir(parents=True)
    for path in (place.onnx, place.int8):
        path.write_bytes(b"graph")
    place.finish({"run": run.id, "int8": {"default": True}})
    return run


def test_a_folder_under_anothers_id_is_no_run(tmp_path: Path):
    """Its numbers would stand for a training that never was. A copy of another name is one."""
    run = complete(tmp_path)
    other = Run.of(tmp_path, "0123456789abcdef")
    shutil.copytree(run.folder, other.folder)
    copy = Run(shutil.copytree(run.folder, tmp_path / "best"))
    assert (run.done, other.done, copy.done) == (True, False, True)
    assert (run.has("int8-0"), other.has("int8-0"), copy.has("int8-0")) == (True, False, True)


@pytest.mark.parametrize("name", ["stream-0", "stream-1"])
def test_an_evaluation_of_another_run_or_name_is_refused(tmp_path: Path, name: str):
    run = complete(tmp_path)
    other = run if name == "stream-1" else complete(tmp_path, CONFIG | {"seed": 1})
    shutil.copy(run.evaluation("stream-0"), other.evaluation(name))
    load(run.folder, ["stream-0"])
    with pytest.raises(InputError, match=rf"evaluations/{name}\.json: cannot be read"):
        load(other.folder, [name])
    assert other.verify() == [f"evaluations/{name}.json"]


def test_a_deployment_that_lost_a_file_is_made_again(tmp_path: Path):
    """And is not, in silence, the float32 one."""
    run = complete(tmp_path)
    assert run.preferred_onnx == run.deployment("int8-0").int8
    run.deployment("int8-0").int8.unlink()
    assert not run.has("int8-0")
    assert run.preferred_onnx != run.deployment("int8-0").onnx


def test_weights_that_changed_since_are_refused(tmp_path: Path):
    run = complete(tmp_path)
    assert run.weights() == run.model
    run.model.write_bytes(b"other")
    with pytest.raises(InputError, match="not the weights that were trained"):
        run.weights()


def test_todays_recipes_come_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """What is shown and deployed of a run, where some is of an older recipe, be it the later."""
    run = begun(tmp_path)
    config = {"export": {"graph": "naive", "precision": "int8"}, "evaluation": {}}
    fp32 = {"export": {"graph": "naive", "precision": "fp32"}}

    def make(config: dict, value: float, graph: bytes) -> None:
        settings = evaluation_settings(config, "stream")
        report = {"mode": "stream", "settings": settings, "mean": {"rotation": {"MPJPE": value}}, "clips": []}
        write_report(run.evaluation(evaluation_id(config, "stream")), report)
        place = run.deployment(deployment_id(config))
        place.folder.mkdir(parents=True)
        for path in (place.onnx, *([place.int8] if graph == b"old" else [])):
            path.write_bytes(graph)
        place.finish({"settings": deployment_settings(config), "int8": {"default": True}})

    with monkeypatch.context() as today:
        today.setitem(memmlp.runs.recipes.RECIPES, "metrics", 2)
        today.setitem(memmlp.runs.recipes.RECIPES, "graph.naive", 2)
        make(fp32, 2.0, b"new")
    make(config, 1.0, b"old")
    assert run.results["stream"]["rotation"]["MPJPE"] == 1.0
    monkeypatch.setitem(memmlp.runs.recipes.RECIPES, "metrics", 2)
    monkeypatch.setitem(memmlp.runs.recipes.RECIPES, "graph.naive", 2)
    assert run.results["stream"]["rotation"]["MPJPE"] == 2.0
    assert load(run.folder).means["stream"]["rotation"]["MPJPE"] == 2.0
    assert run.preferred_onnx.read_bytes() == b"new"


def test_a_run_without_its_artifact_cannot_finish(tmp_path: Path):
    run = begun(tmp_path)
    with pytest.raises(FileNotFoundError):
        run.finish(["model.safetensors"])
    assert not run.done


def test_verify_names_what_changed(tmp_path: Path):
    run = begun(tmp_path)
    for name in ("results.json", "clips.json", "latency.json"):
        write_json(run.folder / name, {})
    run.finish(["results.json", "clips.json", "latency.json"])
    place, report = run.deployment("fp32-0"), run.evaluation("stream-0")
    place.folder.mkdir(parents=True)
    place.onnx.write_bytes(b"graph")
    place.finish({})
    write_report(report, {"mode": "stream", "mean": {"rotation": {"MPJPE": math.nan}}, "clips": []})
    assert intact(report)
    assert run.verify() == []
    (run.folder / "clips.json").write_text("{ }")
    (run.folder / "latency.json").unlink()
    place.onnx.write_bytes(b"other")
    report.write_text(report.read_text().replace("nan", "0.1"))
    assert run.verify() == [
        "clips.json", "latency.json", "deployments/fp32-0/step.onnx", "evaluations/stream-0.json"
    ]  # fmt: skip


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "file"
    atomic_write(path, "old")

    def fail(*_: object) -> None:
        raise OSError("no space")

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(OSError, match="no space"):
        atomic_write(path, "new")
    assert path.read_text() == "old"


def test_reset_removes_the_runs_files_and_no_others(tmp_path: Path):
    run = begun(tmp_path)
    for name in Run.FILES:
        path = run.folder / name.replace("*", "0")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("{}")
    (run.folder / ".checkpoint.safetensors.123.tmp").touch()
    (run.folder / "notes.txt").touch()
    run.finish(["results.json"])
    run.reset()
    assert [path.name for path in run.folder.iterdir()] == ["notes.txt"]
    assert not run.done


def test_a_training_that_is_resumed_elsewhere_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Its weights come from both machines and both versions of the code."""
    run = Run.of(tmp_path, "0" * 16)

    def begin(device: str, commit: str, dirty: bool, losses: str) -> dict:
        made = {"git": {"commit": commit, "dirty": dirty}, "cpu": "A"}
        monkeypatch.setattr("memmlp.runs.run.environment", lambda: made)
        monkeypatch.setattr("memmlp.runs.run.sources", lambda: {"losses.py": losses, "ik.py": "i"})
        run.begin("memmlp", {}, data="d", upstream=None, device=device, threads=2)
        return run.manifest

    begin("cuda:0", "a" * 40, True, "old")
    assert begin("cpu", "b" * 40, False, "new")["device"] == "cpu"  # nothing was trained before
    run.checkpoint.touch()
    found = begin("cuda:0", "c" * 40, False, "newer")
    assert (found["device"], found["threads"], found["cpu"]) == ("cpu, cuda:0", 2, "A")
    assert found["git"] == {"commit": "c" * 40, "dirty": False, "before": "b" * 40}
    assert run.changed_sources == ["losses.py"]


def test_a_reset_that_is_cut_short_leaves_no_results_of_what_is_gone(tmp_path: Path, monkeypatch):
    """At any moment, what is removed first is what was made from the rest."""
    run = begun(tmp_path)
    for name in Run.FILES:
        path = run.folder / name.replace("*", "0")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("{}")
    unlink, left = Path.unlink, []

    def spy(path: Path, missing_ok: bool = False) -> None:
        unlink(path, missing_ok=missing_ok)
        results = [
            run.checkpoint,
            run.model,
            *run.folder.glob("evaluations/*"),
            *run.folder.glob("deployments/*/*"),
        ]
        left.append((run.manifest_path.exists(), any(one.exists() for one in results)))

    monkeypatch.setattr(Path, "unlink", spy)
    run.reset()
    assert (False, True) not in left
    assert left[-1] == (False, False)


def test_reset_removes_the_marker_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    run = begun(tmp_path)
    run.finish(["config.yaml"])
    removed = []
    unlink = Path.unlink

    def spy(path: Path, missing_ok: bool = False) -> None:
        removed.append(path.name)
        unlink(path, missing_ok=missing_ok)

    monkeypatch.setattr(Path, "unlink", spy)
    run.reset()
    assert removed[0] == "DONE"


def test_a_resumed_run_keeps_its_start(tmp_path: Path):
    run = begun(tmp_path)
    run.write_manifest({"started": "2020-01-01T00:00:00+00:00", "finished": "x"})
    begun(tmp_path)
    assert run.manifest["started"].startswith("2020")
    assert run.manifest["finished"] is None
    assert run.config == CONFIG


def test_a_log_may_go_on_after_a_reset(tmp_path: Path):
    run = begun(tmp_path)
    run.log(1, {"loss": 1.0})
    run.reset()
    run.begin("memmlp", CONFIG, data="d", upstream=None)
    run.log(2, {"loss": 1.0})
    assert [entry.step for entry in run.metrics()] == [2]


HOLD = """
import sys, time
from memmlp.runs.run import Run
from memmlp.tables.measured_run import load
with Run(sys.argv[1]).lock():
    print("held", flush=True)
    sys.stdin.read()
"""


@contextlib.contextmanager
def holding(run: Run) -> Iterator[subprocess.Popen]:
    """A process that holds the run until its input ends."""
    line = [sys.executable, "-c", HOLD, str(run.folder)]
    with started(line, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        assert holder.stdout.readline() == b"held\n"
        yield holder


def test_another_process_waits_and_says_for_whom(tmp_path: Path):
    run = begun(tmp_path)
    said: list[str] = []
    with holding(run) as holder:

        def waiting(line: str) -> None:
            said.append(line)
            holder.stdin.close()  # only now it lets go

        with run.lock(waiting):
            assert len(said) == 1
    assert f"process {holder.pid} since" in said[0]


def test_a_killed_holder_frees_the_lock(tmp_path: Path):
    run = begun(tmp_path)
    with holding(run) as holder:
        holder.kill()
        holder.wait()
        said: list[str] = []
        with run.lock(said.append):
            assert said == []


def test_runs_are_found_by_the_beginning_of_their_id(tmp_path: Path):
    runs = [begun(tmp_path, CONFIG | {"seed": seed}) for seed in range(20)]
    (tmp_path / "runs" / "notes").mkdir()
    assert {run.id for run in list_runs(tmp_path)} == {run.id for run in runs}
    assert find_run(tmp_path, runs[3].id).folder == runs[3].folder
    assert find_run(tmp_path, runs[3].id[:12]).id == runs[3].id
    assert find_run("elsewhere", str(runs[3].folder)).id == runs[3].id


def test_the_newest_run_is_first(tmp_path: Path):
    for seed in range(3):
        begun(tmp_path, CONFIG | {"seed": seed}).write_manifest({"started": f"202{seed}"})
    assert [run.manifest["started"] for run in list_runs(tmp_path)] == ["2022", "2021", "2020"]


@pytest.mark.parametrize("name", ["zz", "", "no/such"])
def test_no_such_run_is_one_line(tmp_path: Path, name: str):
    begun(tmp_path)
    with pytest.raises(InputError, match="no such folder"):
        find_run(tmp_path, name)


def test_a_run_by_the_bare_name_of_its_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    made = Run.of(tmp_path, "ab" + "0" * 14)
    made.begin("memmlp", {}, data="d", upstream=None)
    monkeypatch.chdir(made.folder.parent)
    assert find_run("outputs", made.id).folder == made.folder.resolve()


def test_an_ambiguous_beginning_lists_the_runs(tmp_path: Path):
    for name in ("ab" + "0" * 14, "ab" + "1" * 14):
        Run.of(tmp_path, name).begin("memmlp", {}, data="d", upstream=None)
    with pytest.raises(InputError, match=r"2 ids begin so: ab0+, ab1+"):
        find_run(tmp_path, "ab")


def test_diff_names_what_differs(tmp_path: Path):
    a, b = begun(tmp_path), begun(tmp_path, CONFIG | {"seed": 1, "extra": True})
    write_json(a.results_path, {"stream": {"MPJPE": 1.0, "same": 2}})
    write_json(b.results_path, {"stream": {"MPJPE": 3.0, "same": 2}})
    found = diff(a, b)
    assert found.config == {"seed": (0, 1), "extra": ("-", True)}
    assert found.results == {"stream.MPJPE": (1.0, 3.0)}


@pytest.mark.parametrize("text", ["a: [b", "5", "[]"])
def test_a_damaged_config_is_named(tmp_path: Path, text: str):
    run = begun(tmp_path)
    run.config_path.write_text(text)
    with pytest.raises(InputError, match=r"config\.yaml: cannot be read"):
        _ = run.config


def test_a_retry_of_a_run_that_never_began_leaves_it_new(tmp_path: Path):
    run = Run.of(tmp_path, "a" * 16)
    run.folder.mkdir(parents=True)
    run.fail("its data is gone")
    run.retry()
    assert run.status == "new"


def test_flatten_keeps_lists_and_empty_mappings():
    assert flatten({"a": {"b": 1, "c": {}}, "d": [1]}) == {"a.b": 1, "a.c": {}, "d": [1]}


def test_environment_says_what_ran_without_the_machines_name():
    import platform

    found = environment()
    assert {"version", "git", "python", "packages", "platform", "cpu", "cores", "host"} == set(found)
    assert found["packages"]["torch"].startswith("2.")
    assert platform.node() not in json.dumps(found)


def test_runs_need_neither_torch_nor_hydra():
    code = "import sys, memmlp.runs.run; print([m for m in ('torch', 'hydra', 'mlflow') if m in sys.modules])"
    assert finished([sys.executable, "-c", code]).stdout == "[]\n"
