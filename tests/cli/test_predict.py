"""`memmlp predict`: a run's predictions as files of other programs."""

import contextlib
import shutil
from pathlib import Path

import command_line
import numpy as np
import pytest
from cli.conftest import find_trained

from memmlp.common.files import write_json
from memmlp.config.open_run import open_run
from memmlp.evaluation.predictions import predict_clip
from memmlp.motion.body import describe_body
from memmlp.motion.formats.bvh import read_bvh
from memmlp.motion.formats.npz import read_clip


@pytest.fixture(scope="module")
def home(tiny_home: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the folder with one finished run, and its clips as npz; tests add files alone."""
    home = Path(shutil.copytree(tiny_home, tmp_path_factory.mktemp("home") / "home"))
    command_line.run(home, "data", "synth", "--out", "clips", "--minutes", "0.2", "--seed", "3")
    return home


@pytest.fixture(scope="module")
def run(home: Path) -> str:
    return find_trained(home).id


@pytest.fixture(scope="module")
def clip(home: Path, run: str) -> str:
    with contextlib.chdir(home):
        return open_run(Path("outputs"), run).test.names[0]


def test_a_test_clip_is_written_in_every_format(home: Path, run: str, clip: str):
    for name in ("a.bvh", "a.glb", "deep/a.npz"):
        said = command_line.run(home, "predict", run, clip, "--out", name)
        assert f"run {run}: hardly trained (its steps saw " in said
        assert said.startswith(f"run {run}: rotation, stream mode\n1 clip, ")
        assert (home / name).stat().st_size > 10_000
    with contextlib.chdir(home):
        opened = open_run(Path("outputs"), run)
        frames = opened.test.read_clip(0)
        expected = predict_clip(opened.network(), frames, "stream")["predicted_positions"]
    root = read_bvh(home / "a.bvh").compute_kinematics()[1][:, 0]
    np.testing.assert_allclose(root / 100, expected[:, 0][:, [0, 2, 1]] * [1, 1, -1], atol=1e-5)


def test_mode_branch_and_inverse_kinematics_are_told(home: Path, run: str, clip: str):
    words = {
        "window": ["--mode", "window"], "lbfgs": ["--ik", "lbfgs"], "truth": ["--branch", "truth"],
        "plain": ["--ik", "lbfgs", "--branch", "rotation"], "rotation": [],
    }  # fmt: skip
    said = {
        name: command_line.run(home, "predict", run, clip, "--out", f"{name}.npz", *options)
        for name, options in words.items()
    }
    assert "rotation, window mode" in said["window"]
    assert "combined, stream mode" in said["lbfgs"]
    assert "truth, stream mode" in said["truth"]
    poses = {name: read_clip(home / f"{name}.npz", name).poses for name in words}
    np.testing.assert_array_equal(poses["plain"], poses["rotation"])
    for name in ("window", "lbfgs", "truth"):
        assert np.abs(poses[name] - poses["rotation"]).max() > 1e-3


def test_foreign_clips_need_the_run_alone(home: Path, run: str, tmp_path: Path):
    shutil.copytree(home / "outputs" / "runs", tmp_path / "outputs" / "runs")
    shutil.copytree(home / "clips", tmp_path / "clips")
    (tmp_path / "clips" / "bad.npz").write_bytes(b"none")
    said = command_line.run(tmp_path, "predict", run, "clips", "--out", "out", "--format", "gltf")
    assert "skipped bad.npz: " in said
    made = {file.relative_to(tmp_path / "out").with_suffix("") for file in (tmp_path / "out").rglob("*.glb")}
    clips = {f.relative_to(tmp_path / "clips").with_suffix("") for f in (tmp_path / "clips").rglob("*.npz")}
    assert made == clips - {Path("bad")} != set()
    assert not (tmp_path / "outputs" / "cache").exists()
    write_json(tmp_path / "clips" / "import.json", describe_body("model.npz", np.ones((22, 3))))
    line = command_line.run(tmp_path, "predict", run, "clips", "--out", "b", "--format", "gltf", code=2)
    assert "imported for the body model.npz" in line


REFUSED = {
    "nobody --out b.bvh": ("SOURCE nobody", "test clip"),
    "CLIP --out b.fbx": ("--out b.fbx", ".bvh, .npz, .glb"),
    "CLIP --out b.glb --format bvh": ("--out b.glb", ".bvh"),
    "CLIP --out b.bvh --branch combined": ("--branch combined", "--ik lbfgs"),
    "clips --out b": ("--format", "bvh, npz, gltf"),
    "clips/none.npz --out b.bvh": ("clips/none.npz",),
}


def test_bad_input_is_one_line(home: Path, run: str, clip: str):
    for words, said in REFUSED.items():
        given = [clip if word == "CLIP" else word for word in words.split()]
        line = command_line.run(home, "predict", run, *given, code=2)
        assert line.startswith("memmlp: ")
        assert line.count("\n") == 1
        assert all(word in line for word in said), words
    assert not [path for path in home.iterdir() if path.stem == "b"]
