"""Copies at another frame rate: one motion, and so one part and one group."""

import functools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from memmlp.motion.body import SWAPPED
from memmlp.motion.clip import Clip, resample
from memmlp.motion.formats.npz import write_clip
from memmlp.motion.preparing.cache import ClipFolder, prepare
from memmlp.motion.preparing.folder_survey import survey
from memmlp.motion.preparing.splits import ListSplit, SeededSplit
from memmlp.motion.synthetic import synthesize_clip

ACTIVITIES = ("walking", "running", "idling", "waving", "jumping", "punching")


@functools.cache
def recorded(activity: str, seed: int = 1) -> Clip:
    return synthesize_clip(activity, seed, seconds=2.0, fps=120.0)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for activity in ACTIVITIES:
        write_clip(tmp_path / "clips" / "a" / f"{activity}.npz", recorded(activity))
    return tmp_path / "clips"


@pytest.mark.parametrize("fps", [20.0, 50.0, 60.0, 119.88, 250.0])
def test_a_copy_at_another_rate_is_seen(root, fps):
    for activity in ACTIVITIES:
        write_clip(root / "b" / f"{activity}_again.npz", resample(recorded(activity), fps)[0])
    found = survey(root)
    assert found.duplicates == {f"b/{activity}_again": f"a/{activity}" for activity in ACTIVITIES}
    assert len(found.clips) == 2 * len(ACTIVITIES)


@pytest.mark.parametrize("fps", [20.0, 60.0])
def test_a_mirrored_copy_at_another_rate_is_seen(root, fps, monkeypatch):
    """At 20 Hz quick motion has no stretch in common with its original that were alike enough."""
    monkeypatch.setattr("memmlp.motion.preparing.folder_survey.sharing", lambda *_: [])
    for activity in ACTIVITIES:
        clip = resample(recorded(activity), fps)[0]
        poses, trans = clip.poses[:, list(SWAPPED)] * np.array([1, -1, -1]), clip.trans * np.array([-1, 1, 1])
        write_clip(root / "b" / f"{activity}_M.npz", replace(clip, poses=poses, trans=trans))
    assert survey(root).duplicates == {f"b/{activity}_M": f"a/{activity}" for activity in ACTIVITIES}


def test_copies_of_copies_are_one(root):
    for fps in (24.0, 60.0, 90.0):
        write_clip(root / "b" / f"{fps:g}.npz", resample(recorded("walking"), fps)[0])
    write_clip(root / "c.npz", recorded("walking"))
    assert set(survey(root).duplicates.values()) == {"a/walking"}
    assert len(survey(root).duplicates) == 4


def test_what_begins_alike_and_goes_on_otherwise_is_no_copy(root, monkeypatch):
    monkeypatch.setattr(
        "memmlp.motion.preparing.folder_survey.sharing", lambda *_: []
    )  # what has parts of it
    clip = resample(recorded("walking"), 60.0)[0]
    run = resample(recorded("running"), 60.0)[0]
    write_clip(root / "b" / "turns.npz", replace(clip, poses=np.concatenate([clip.poses[:1], run.poses[1:]])))
    write_clip(root / "b" / "part.npz", replace(clip, poses=clip.poses[:60], trans=clip.trans[:60]))
    slope = np.linspace(0, 0.1, len(clip))[:, None] * [1, 0, 0]
    write_clip(root / "b" / "drifts.npz", replace(clip, trans=clip.trans + slope))
    write_clip(root / "b" / "other.npz", resample(recorded("walking", 2), 60.0)[0])
    assert survey(root).duplicates == {}


@pytest.mark.parametrize("seed", range(2))
def test_copies_are_drawn_together(root, tmp_path, seed):
    for activity in ACTIVITIES:
        write_clip(root / "b" / f"{activity}_again.npz", resample(recorded(activity), 30.0)[0])
    manifest = prepare(ClipFolder(root, SeededSplit(0.3, 0.3, seed=seed)), tmp_path / "cache")
    parts = {clip.name: clip.split for clip in manifest.clips}
    assert set(parts.values()) == {"train", "val", "test"}
    assert all(parts[f"a/{activity}"] == parts[f"b/{activity}_again"] for activity in ACTIVITIES)
    assert len({clip.group for clip in manifest.clips}) == len(ACTIVITIES)


def test_a_lists_training_gives_way_to_its_test(root, tmp_path):
    write_clip(root / "b" / "again.npz", resample(recorded("running"), 60.0)[0])
    for part, names in (("train", [f"a/{name}" for name in ACTIVITIES]), ("test", ["b/again"])):
        lists = tmp_path / "lists" / names[0].split("/")[0]
        lists.mkdir(parents=True)
        for phase in ("train", "test"):
            (lists / f"{phase}_split.txt").touch()
        (lists / f"{part}_split.txt").write_text("".join(f"{name}.npz\n" for name in names))
    manifest = prepare(ClipFolder(root, ListSplit(tmp_path / "lists")), tmp_path / "cache")
    assert manifest.duplicates == {"a/running": "b/again"}
