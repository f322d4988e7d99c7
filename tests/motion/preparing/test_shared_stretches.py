"""Clips that have some frames in common: one part, and one group."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from memmlp.motion.body import SWAPPED
from memmlp.motion.clip import Clip, resample
from memmlp.motion.formats.npz import write_clip
from memmlp.motion.preparing.cache import ClipFolder, prepare
from memmlp.motion.preparing.folder_survey import survey
from memmlp.motion.preparing.shared_stretches import REACH, _turns, marks
from memmlp.motion.preparing.shared_stretches import in_mirror as in_mirror_of_turns
from memmlp.motion.preparing.splits import ListSplit, SeededSplit
from memmlp.motion.synthetic import synthesize_clip

ACTIVITIES = ("walking", "running", "waving", "sitting", "punching", "squatting")  # all the while


def cut(clip: Clip, start: int, end: int | None = None) -> Clip:
    return replace(clip, poses=clip.poses[start:end], trans=clip.trans[start:end])


def rounded(clip: Clip) -> Clip:
    """As a text file has it, with three decimals."""
    return replace(clip, poses=clip.poses.round(3), trans=clip.trans.round(3))


def elsewhere(clip: Clip) -> Clip:
    """Turned about the vertical and moved away, with a drift."""
    turn = Rotation.from_euler("z", 70, degrees=True)
    poses = clip.poses.copy()
    poses[:, 0] = (turn * Rotation.from_rotvec(poses[:, 0])).as_rotvec()
    drift = np.linspace(0, 0.2, len(clip))[:, None]
    place = turn.apply(clip.trans) + np.array([1, 2, 0]) + drift
    return replace(clip, poses=poses, trans=place.astype(np.float32))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    for activity in ACTIVITIES:
        write_clip(tmp_path / "clips" / f"{activity}.npz", synthesize_clip(activity, 1, seconds=5.0))
    return tmp_path / "clips"


@pytest.mark.parametrize(
    "changed",
    [rounded, elsewhere, lambda clip: cut(clip, 0, 150), lambda clip: rounded(cut(clip, 97, 230))],
    ids=["precision", "place", "beginning", "middle"],
)
def test_what_has_some_of_a_clips_frames_is_seen(root: Path, changed):
    for activity in ACTIVITIES:
        write_clip(root / f"{activity}_part.npz", changed(synthesize_clip(activity, 1, seconds=5.0)))
    assert survey(root).duplicates == {f"{activity}_part": activity for activity in ACTIVITIES}


def in_mirror(clip: Clip) -> Clip:
    """As data sets ship it: left and right joints change places, and rotation vectors keep their x alone."""
    poses = clip.poses[:, list(SWAPPED)] * np.array([1, -1, -1])
    return replace(clip, poses=poses, trans=clip.trans * np.array([-1, 1, 1], np.float32))


@pytest.mark.parametrize(
    "changed",
    [in_mirror, lambda clip: rounded(cut(in_mirror(clip), 97, 230)), lambda clip: elsewhere(in_mirror(clip))],
    ids=["whole", "middle", "place"],
)
def test_a_clip_and_its_mirror_image_are_one(root: Path, changed):
    """Otherwise one of them is in test and the other in training."""
    for activity in ACTIVITIES:
        write_clip(root / f"{activity}_mirrored.npz", changed(synthesize_clip(activity, 1, seconds=5.0)))
    assert survey(root).duplicates == {f"{activity}_mirrored": activity for activity in ACTIVITIES}


def test_mirrored_rotations_are_those_of_mirrored_frames():
    clip = synthesize_clip("waving", 1, seconds=5.0)
    found = in_mirror_of_turns(_turns(clip))
    np.testing.assert_allclose(found, _turns(in_mirror(clip)), atol=1e-6)


def test_windows_of_one_recording_are_one(root: Path):
    """Each overlaps the next by two seconds, and the first and the last have nothing in common."""
    recording = synthesize_clip("reaching", 5, seconds=14.0)
    for start in range(0, 600, 120):
        write_clip(root / f"window_{start:03}.npz", cut(recording, start, start + 240))
    assert set(survey(root).duplicates.values()) == {"window_000"}
    assert len(survey(root).duplicates) == 4


def test_a_cut_at_another_rate_is_seen(root: Path):
    recorded = synthesize_clip("walking", 3, seconds=6.0, fps=120.0)
    write_clip(root / "a.npz", recorded)
    write_clip(root / "b.npz", resample(cut(recorded, 120, 600), 60.0)[0])
    assert survey(root).duplicates == {"b": "a"}


def test_repetitions_and_cuts_without_common_frames_are_none(root: Path):
    recording = synthesize_clip("reaching", 5, seconds=10.0)
    for activity in ACTIVITIES:
        write_clip(root / f"{activity}_again.npz", synthesize_clip(activity, 2, seconds=5.0))
    for name, (start, end) in {"first": (0, 300), "second": (300, 600)}.items():
        write_clip(root / f"{name}.npz", cut(recording, start, end))
    assert survey(root).duplicates == {}


def test_who_stands_still_is_like_many_others(root: Path):
    for activity in ("walking", "waving"):
        clip = synthesize_clip(activity, 7, seconds=4.0)
        still = np.zeros((180, 22, 3), np.float32)  # a rest pose of three seconds, such as files begin with
        place = np.repeat(clip.trans[:1], 180, 0)
        poses, trans = np.concatenate([still, clip.poses]), np.concatenate([place, clip.trans])
        write_clip(root / f"{activity}_begun.npz", replace(clip, poses=poses, trans=trans))
    assert survey(root).duplicates == {}


@pytest.mark.parametrize("frames", [1, 2, 2 * REACH, 2 * REACH + 1])
def test_a_clip_too_short_for_a_stretch_has_no_marks_beyond_its_middle(frames: int):
    clip = cut(synthesize_clip("walking", 1, seconds=2.0), 0, frames)
    for marked in marks(clip):
        assert set(marked.frames) <= {REACH}
        assert marked.signatures.shape == (len(marked.frames), 24)


@pytest.mark.parametrize("seed", range(3))
def test_they_are_drawn_together(root: Path, tmp_path: Path, seed: int):
    for activity in ACTIVITIES:
        write_clip(root / f"{activity}_cut.npz", cut(synthesize_clip(activity, 1, seconds=5.0), 60))
    manifest = prepare(ClipFolder(root, SeededSplit(0.3, 0.3, seed=seed)), tmp_path / "cache")
    parts = {clip.name: clip.split for clip in manifest.clips}
    assert set(parts.values()) == {"train", "val", "test"}
    assert all(parts[activity] == parts[f"{activity}_cut"] for activity in ACTIVITIES)
    assert len({clip.group for clip in manifest.clips}) == len(ACTIVITIES)


def test_a_lists_training_gives_way_to_its_test(tmp_path: Path):
    clip, other = synthesize_clip("running", 1, seconds=5.0), synthesize_clip("waving", 1)
    for name, part in {"a/whole": clip, "a/other": other, "b/cut": cut(clip, 90)}.items():
        write_clip(tmp_path / "clips" / f"{name}.npz", part)
    for part, names in (("train", ["a/whole", "a/other"]), ("test", ["b/cut"])):
        lists = tmp_path / "lists" / names[0].split("/")[0]
        lists.mkdir(parents=True)
        for phase in ("train", "test"):
            (lists / f"{phase}_split.txt").touch()
        (lists / f"{part}_split.txt").write_text("".join(f"{name}.npz\n" for name in names))
    split = ListSplit(tmp_path / "lists", val=0)
    manifest = prepare(ClipFolder(tmp_path / "clips", split), tmp_path / "cache")
    assert manifest.duplicates == {"a/whole": "b/cut"}
