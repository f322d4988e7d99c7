"""`memmlp data synth`, `show`, `prepare` and `inspect`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from conftest import one_line

import memmlp.cli.data as commands
from memmlp.common.errors import InputError
from memmlp.config.build_motion import build_motion
from memmlp.config.compose import composed
from memmlp.motion.clip import Clip
from memmlp.motion.formats.npz import write_clip
from memmlp.motion.preparing.cache import ClipFolder
from memmlp.motion.synthetic import synthesize_clip


@pytest.mark.slow
def test_synthetic_clips_are_not_mixed_with_others(memmlp, tmp_path: Path):
    words = ["data", "synth", "--out", "clips", "--minutes", "0.05"]
    assert memmlp(*words).code == 0
    before = sorted(path.stat().st_mtime_ns for path in tmp_path.rglob("*.npz"))
    assert one_line(memmlp(*words, "--seed", "1"), "--out clips")
    assert sorted(path.stat().st_mtime_ns for path in tmp_path.rglob("*.npz")) == before


def test_a_sheet_is_written_and_bad_files_are_named(tmp_path: Path):
    for name in ("a", "b"):
        write_clip(tmp_path / f"{name}.npz", synthesize_clip("walking", 1, seconds=0.5))
    (tmp_path / "c.npz").write_bytes(b"no")
    out = tmp_path / "sheet.png"
    result = CliRunner().invoke(commands.data, ["show", str(tmp_path), "--out", str(out)])
    assert result.exit_code == 0
    assert "skipped c.npz: " in result.output
    assert f"2 of 3 clips: {out}" in result.output
    assert out.read_bytes().startswith(b"\x89PNG")
    gif = CliRunner().invoke(commands.data, ["show", str(tmp_path), "--out", str(tmp_path / "sheet.gif")])
    assert isinstance(gif.exception, InputError)


@pytest.fixture
def prepared(memmlp, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., ClipFolder]:
    """The source of a cache for some options, without reading it."""
    for name in ("clips", "lists/CMU"):
        (tmp_path / name).mkdir(parents=True)
    for part in ("train", "test"):
        (tmp_path / "lists" / "CMU" / f"{part}_split.txt").write_text(f"CMU/1/{part}.npz\n")
    monkeypatch.chdir(tmp_path)
    found: list[ClipFolder] = []
    monkeypatch.setattr("memmlp.motion.preparing.cache.prepare", lambda source, out: found.append(source))
    monkeypatch.setattr(commands, "show_manifest", lambda manifest: None)

    def of(*words: str) -> ClipFolder:
        ran = memmlp("data", "prepare", "clips", "--out", "cache", *words)
        assert ran.code == 0, ran.err
        return found[-1]

    return of


@pytest.mark.parametrize(
    ("words", "train"),
    [
        ([], ["data=mocap"]),
        (["--split", "s2"], ["data=amass_s2"]),
        (["--split", "lists:lists"], ["data=amass_s1", "data.split.folder=lists"]),
        (
            ["--val", "0.2", "--test", "0.3", "--seed", "4", "--min-frames", "50", "--strict",
             "--group", "a(.)", "--group", "b", "--interpolation", "lines"],
            [
                "data=mocap", "data.split.val=0.2", "data.split.test=0.3", "data.split.seed=4",
                "data.min_frames=50", "data.strict=true", "data.split.groups=['a(.)',b]",
                "data.interpolation=lines",
            ],
        ),
    ],
    ids=str,
)  # fmt: skip
def test_a_cache_has_the_clips_of_training(
    prepared: Callable[..., ClipFolder], words: list[str], train: list[str]
):
    assert prepared(*words) == build_motion(composed([*train, "data.root=clips"])).clips


@pytest.mark.parametrize(
    ("words", "key"),
    [
        (["--split", "s3"], "--split s3"),
        (["--val", "2"], "data.val=2.0"),
        (["--split", "s2", "--test", "0.4"], "--test 0.4"),
    ],
)
def test_bad_options_are_refused(memmlp, words: list[str], key: str):
    assert one_line(memmlp("data", "prepare", "clips", "--out", "cache", *words), key)


def test_folders_in_training_and_in_test_are_reported(memmlp, tmp_path: Path):
    rng = np.random.default_rng(0)
    for person in ("anna", "ben"):
        for take in range(8):
            poses = 0.05 * np.cumsum(rng.normal(size=(90, 22, 3)), 0)
            clip = Clip("", poses, 0.01 * np.cumsum(rng.normal(size=(90, 3)), 0), 60.0)
            write_clip(tmp_path / "own" / person / f"{take}.npz", clip)
    cache = str(tmp_path / "cache")
    prepared = memmlp("data", "prepare", str(tmp_path / "own"), "--out", cache, "--test", "0.4")
    for ran in (prepared, memmlp("data", "inspect", cache)):
        assert ran.code == 0, ran.err
        assert "test clips are tied to no others (data.split.groups)" in ran.out
