"""What a script or a notebook does with finished runs."""

import contextlib
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from own_package import registers_kept

import memmlp
from memmlp.common.files import read_json, write_json
from memmlp.evaluation.metric_facts import UNITS
from memmlp.runs.evaluation_file import write_report
from memmlp.runs.lookup import list_runs

ROOT = Path(memmlp.__file__).parents[1]
UPRIGHT = ((0.0, 1.6, 0.0), np.eye(3))


@pytest.fixture(scope="module")
def home(tiny_home: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(shutil.copytree(tiny_home, tmp_path_factory.mktemp("home") / "home"))


@pytest.fixture(autouse=True)
def _where_it_was_trained(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(home)


@pytest.fixture(scope="module")
def run(home: Path) -> memmlp.TrainedRun:
    (only,) = memmlp.Runs(home / "outputs")
    return only


@pytest.fixture(scope="module")
def prediction(home: Path, run: memmlp.TrainedRun) -> memmlp.Prediction:
    with contextlib.chdir(home):
        return run.predict(run.clips[0])


@pytest.fixture
def three(run: memmlp.TrainedRun, tmp_path: Path) -> memmlp.Runs:
    """The run and two copies of it under other ids, started later and earlier, of seeds 1 and 2."""
    shutil.copytree(run.folder, tmp_path / "runs" / run.id)
    for seed, started in ((1, "2999-01-01"), (2, "2000-01-01")):
        folder = Path(shutil.copytree(run.folder, tmp_path / "runs" / (str(seed) * 16)))
        own = {"run": folder.name}  # what lies in a run's folder names its run
        write_json(folder / "DONE", read_json(folder / "DONE") | {"id": folder.name})
        for report in folder.glob("evaluations/*.json"):
            content = read_json(report)
            del content["digest"]
            write_report(report, {**content, **own})
        write_json(folder / "manifest.json", read_json(folder / "manifest.json") | {"started": started})
        (folder / "config.yaml").write_text(yaml.safe_dump(run.config | {"seed": seed}))
    return memmlp.Runs(tmp_path)


def refused(*words: str) -> contextlib.AbstractContextManager[object]:
    """An InputError of one line that begins with the first word and contains the others."""
    return pytest.raises(memmlp.InputError, match=r"^(?![\s\S]*\n)" + ".*".join(map(re.escape, words)))


def test_load_run_takes_ids_prefixes_and_folders_of_finished_runs(
    run: memmlp.TrainedRun, three: memmlp.Runs, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (codes,) = [found for found in list_runs("outputs") if found.id != run.id]
    for name, word in (("nobody", "nobody"), ("", "''"), (codes.id, "a finished run of a motion network")):
        with refused("run", word):
            memmlp.load_run(name)
    (tmp_path / "runs" / run.id / "DONE").unlink()
    assert [found.seed for found in memmlp.Runs(tmp_path)] == [1, 2]
    with refused(f"run {run.id}", "a finished run"):
        memmlp.load_run(run.id, tmp_path)
    for name in (run.id, run.id[:6], run.folder, f"outputs/runs/{run.id}", run):
        found = memmlp.load_run(name, "outputs")
        assert (found.id, found.folder) == (run.id, run.folder)
    assert memmlp.load_run(run.id).id == memmlp.Runs()[0].id == run.id
    empty = tmp_path / "empty"
    monkeypatch.setenv("MEMMLP_OUTPUTS", str(empty))
    with refused(f"run '{run.id}'", str(empty)):
        memmlp.load_run(run.id)
    with refused("outputs", str(empty)):
        memmlp.Runs()
    (empty / "runs").mkdir(parents=True)
    assert len(memmlp.Runs()) == 0


def test_runs_are_a_sequence_with_the_newest_first(three: memmlp.Runs):
    assert [run.seed for run in three] == [1, 0, 2]
    assert (len(three), three[-1].seed) == (3, 2)
    rest = three[1:]
    assert isinstance(rest, memmlp.Runs)
    assert [run.seed for run in rest] == [0, 2]
    assert repr(rest) == f"Runs([{three[1]!r}, TrainedRun('{'2' * 16}')])"
    whole = three.per_clip()
    pd.testing.assert_frame_equal(whole, pd.concat([run.per_clip() for run in three], ignore_index=True))
    assert whole["seed"].unique().tolist() == [1, 0, 2]
    assert whole.attrs["units"] == UNITS
    assert list(three[:0].per_clip().columns) == list(whole.columns)


def test_config_and_results_are_those_of_the_folder(run: memmlp.TrainedRun, monkeypatch: pytest.MonkeyPatch):
    config = yaml.safe_load((run.folder / "config.yaml").read_text())
    assert (run.config, run.seed, run.combined_by) == (config, 0, {})
    frame = run.per_clip()
    facts = ["run", "seed", "mode", "branch", "combined_by", "clip", "group", "frames"]
    assert list(frame.columns) == [*facts, *UNITS]
    assert frame.attrs["units"]["MPJPE"] == "cm"
    assert frame["combined_by"].isna().all()
    pairs = [(mode, branch) for mode in ("stream", "window") for branch in ("rotation", "position")]
    assert list(frame[["mode", "branch"]].itertuples(index=False, name=None)) == pairs  # one test clip
    assert list(run.results) == ["stream", "window"]
    for row, (mode, branch) in zip(frame.to_dict("records"), pairs, strict=True):
        (file,) = run.folder.glob(f"evaluations/{mode}-*.json")
        (clip,) = read_json(file)["clips"]
        assert run.results[mode] == read_json(file)["mean"]
        assert (row["clip"], row["group"], row["frames"]) == (clip["name"], clip["group"], clip["frames"])
        assert {name: row[name] for name in clip[branch]} == clip[branch]
        assert np.isnan(row["MPJRE"]) == (branch == "position")
    monkeypatch.setitem(sys.modules, "pandas", None)
    with refused("per_clip: needs pandas", "memmlp[notebook]"):
        run.per_clip()


def test_a_prediction_has_the_evaluated_errors(
    run: memmlp.TrainedRun, prediction: memmlp.Prediction, monkeypatch: pytest.MonkeyPatch
):
    assert (prediction.run, prediction.clip, prediction.mode) == (run.id, run.clips[0], "stream")
    n = len(prediction)
    frame = run.per_clip().set_index(["mode", "branch"])
    for mode, found in (("stream", prediction), ("window", run.predict(run.clips[0], mode="window"))):
        assert frame.loc[(mode, "rotation"), "frames"] == n
        for branch in ("rotation", "position"):
            errors = found.errors(branch)
            assert errors.shape == (n, 22)
            assert errors.mean() == pytest.approx(frame.loc[(mode, branch), "MPJPE"], rel=1e-4)
    assert prediction.true_positions.shape == prediction.positions.shape == (n, 22, 3)
    assert prediction.position_branch is not None
    assert prediction.position_branch.shape == (n, 22, 3)
    for rotations in (prediction.rotations, prediction.true_rotations):
        product = rotations @ rotations.swapaxes(-1, -2)
        np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), (n, 22, 3, 3)), atol=1e-4)
    head = prediction.positions[:, 15] - prediction.true_positions[:, 15]
    np.testing.assert_allclose(head, 0, atol=1e-5)  # on its tracker

    rotation_only = memmlp.load_run(run)
    monkeypatch.setattr(rotation_only.model, "branches", frozenset({"rotation"}))
    found = rotation_only.predict(run.clips[0], "window")
    assert found.position_branch is None
    with refused("branch position", "rotation"):
        found.errors("position")
    with refused("clip nobody", run.clips[0]):
        run.predict("nobody")
    with refused("mode live", "stream, window"):
        run.predict(run.clips[0], "live")  # type: ignore[arg-type]


STILL = """
from memmlp.common.components import component
from memmlp.common.settings import Settings, setting
from memmlp.training.losses import Term

@component("term", "still", builds="Still")
class StillSettings(Settings):
    weight: float = setting(None, 1.0)

class Still(Term): pass
"""


def test_user_code_runs_only_if_the_script_names_its_package(three, tmp_path: Path, monkeypatch):
    """A run's record cannot import anything, not even a module in the current folder."""
    (tmp_path / "mine.py").write_text(STILL)
    monkeypatch.syspath_prepend(tmp_path)
    path = three[0].folder / "config.yaml"
    changes = {"plugins": ["mine"], "term": {"name": "still", "weight": 1.0}}
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | changes))
    with registers_kept():
        with pytest.raises(memmlp.InputError, match=r"trust it, .* in Python plugins=\['mine'\]"):
            _ = memmlp.load_run(path.parent).model
        assert "mine" not in sys.modules
        assert not memmlp.load_run(path.parent, plugins=["mine"]).model.training
    with registers_kept():
        (found,) = (run for run in memmlp.Runs(tmp_path, plugins=["mine"]) if run.folder == path.parent)
        assert found.clips
    for plugins, said in (
        ("mine", "plugins 'mine': expected a list of"),
        (["nowhere"], "plugin nowhere: not"),
    ):
        with pytest.raises(memmlp.InputError, match=said):
            memmlp.load_run(path.parent, plugins=plugins)


def test_a_run_streams(run: memmlp.TrainedRun, three: memmlp.Runs):
    stream = run.stream(space="unity", rotations="quaternion")
    assert isinstance(stream, memmlp.Stream)
    pose = stream.step(UPRIGHT, None, None, time=0.0)
    assert isinstance(pose, memmlp.Pose)
    assert (pose.rotations.shape, stream.space.name) == ((22, 4), "unity")
    assert memmlp.Stream(run).network.path == stream.network.path
    with refused("space=blender"):
        run.stream(space="blender")  # type: ignore[arg-type]
    shutil.rmtree(three[0].folder / "deployments")
    with refused(str(three[0].folder), "step.onnx"):
        three[0].stream()


def test_the_api_is_listed_and_imported_lazily():
    assert dir(memmlp) == sorted(memmlp.__all__)
    for name in memmlp.__all__:
        assert getattr(memmlp, name).__name__ == name
    with pytest.raises(AttributeError, match="Strem"):
        memmlp.Strem  # noqa: B018
    loaded = "print(sorted({'hydra', 'numpy', 'onnxruntime', 'pandas', 'torch'} & set(sys.modules)));"
    later = "memmlp.load_run; print(sorted({'hydra', 'torch'} & set(sys.modules)))"
    code = f"import sys, memmlp; {loaded} {later}"
    ran = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert ran.stdout == "[]\n[]\n"


def test_the_guides_code_runs(home: Path, capsys: pytest.CaptureFixture[str]):
    guide = (ROOT / "docs" / "guides" / "runs.md").read_text(encoding="utf-8")
    names: dict[str, object] = {}
    for block in re.findall(r"```python\n(.*?)```", guide, re.DOTALL):
        exec(block, names)
    assert (home / "clip.png").exists()
    assert "MPJPE" in capsys.readouterr().out
