"""`memmlp data prepare`: what its options and its silence mean."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import one_line

from memmlp.config.build_motion import build_motion
from memmlp.config.compose import composed
from memmlp.motion.preparing.cache import ClipFolder


@pytest.fixture
def prepared(memmlp, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., ClipFolder]:
    """What is prepared for some words, without being read."""
    for name in ("clips", "lists/CMU"):
        (tmp_path / name).mkdir(parents=True)
    for part in ("train", "test"):
        (tmp_path / "lists" / "CMU" / f"{part}_split.txt").write_text(f"CMU/1/{part}.npz\n")
    monkeypatch.chdir(tmp_path)
    found: list[ClipFolder] = []
    monkeypatch.setattr("memmlp.motion.preparing.cache.prepare", lambda source, out: found.append(source))
    command = importlib.import_module("memmlp.cli.data.prepare")
    monkeypatch.setattr(command, "show_manifest", lambda manifest: None)

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
            ["--val", "0.2", "--test", "0.3", "--seed", "4", "--min-frames", "50", "--strict"],
            [
                "data=mocap", "data.split.val=0.2", "data.split.test=0.3", "data.split.seed=4",
                "data.min_frames=50", "data.strict=true",
            ],
        ),
        (["--interpolation", "lines"], ["data=mocap", "data.interpolation=lines"]),
        (["--group", "a(.)", "--group", "b"], ["data=mocap", "data.split.groups=['a(.)',b]"]),
    ],
    ids=str,
)  # fmt: skip
def test_a_cache_has_the_clips_of_training(
    prepared: Callable[..., ClipFolder], words: list[str], train: list[str]
):
    assert prepared(*words) == build_motion(composed([*train, "data.root=clips"])).clips


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--split", "s3"], "--split s3: no such split; allowed: seeded, s2, lists:FOLDER"),
        (["--val", "2"], "data.val=2.0"),
    ],
    ids=str,
)
def test_what_is_refused(memmlp, words: list[str], said: str):
    assert one_line(memmlp("data", "prepare", "clips", "--out", "cache", *words), said)
