"""`memmlp data synth`, `show`, `prepare` and `inspect`."""

import errno
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from cli.conftest import write_random_clip
from click.testing import CliRunner
from conftest import one_line

import memmlp.cli.data as commands
from memmlp.common.errors import InputError
from memmlp.config.build_request import build_request
from memmlp.config.compose import compose_config
from memmlp.motion import synthetic
from memmlp.motion.formats.npz import write_clip
from memmlp.motion.preparing.cache import ClipFolder
from memmlp.motion.synthetic import synthesize_clip


@pytest.mark.slow
def test_synthetic_clips_are_not_mixed_with_others(memmlp, tmp_path: Path, monkeypatch):
    words = ["data", "synth", "--out", "clips", "--minutes", "0.05"]
    with monkeypatch.context() as full:
        disk = Mock(side_effect=[None, OSError(errno.ENOSPC, "No space left on device", "clips/a.npz")])
        full.setattr(synthetic, "write_clip", lambda path, clip: disk() or write_clip(path, clip))
        assert one_line(memmlp(*words), "clips/a.npz: No space left on device")
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


def test_a_cache_has_the_clips_of_training(memmlp, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "clips").mkdir()
    monkeypatch.chdir(tmp_path)
    found: list[ClipFolder] = []
    preparing = "memmlp.motion.preparing.cache.prepare_cache"
    monkeypatch.setattr(preparing, lambda one, out, overwrite: found.append(one))
    monkeypatch.setattr(commands, "show_manifest", lambda manifest: None)
    for words, train in (
        (["data.split.val=0.2"], ["data=mocap", "data.split.val=0.2"]),
        (["data=amass_s2"],) * 2,
    ):
        ran = memmlp("data", "prepare", "clips", "--out", "cache", *words)
        assert ran.code == 0, ran.err
        assert found[-1] == build_request(compose_config([*train, "data.root=clips"])).motion.clips
    bad = memmlp("data", "prepare", "clips", "--out", "cache", "data.split.val=2")
    assert one_line(bad, "data.split.val=2")


def test_prepare_keeps_the_cache_of_other_data_and_inspect_lists_all_bad_files(memmlp, tmp_path: Path):
    rng = np.random.default_rng(0)
    for folder in ("a", "b"):
        for take in range(4):
            write_random_clip(tmp_path / folder / f"{take}.npz", rng)
    for number in range(17):
        (tmp_path / "a" / f"bad{number}.npz").touch()
    assert memmlp("data", "prepare", "a", "--out", "cache").code == 0
    assert one_line(memmlp("data", "prepare", "b", "--out", "cache"), "cache: has a cache of other data")
    assert memmlp("data", "prepare", "a", "--out", "cache").code == 0
    assert memmlp("data", "inspect", "a").out.count("skipped bad") == 17


def test_folders_in_training_and_in_test_are_reported(memmlp, tmp_path: Path):
    rng = np.random.default_rng(0)
    for person in ("anna", "ben"):
        for take in range(8):
            write_random_clip(tmp_path / "own" / person / f"{take}.npz", rng)
    cache = str(tmp_path / "cache")
    prepared = memmlp("data", "prepare", str(tmp_path / "own"), "--out", cache, "data.split.test=0.4")
    for ran in (prepared, memmlp("data", "inspect", cache)):
        assert ran.code == 0, ran.err
        assert "test clips share no group with other clips (data.split.groups)" in ran.out
