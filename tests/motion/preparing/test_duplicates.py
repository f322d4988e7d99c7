"""Clips that share motion: in one part, and one group."""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from memmlp.motion.body import PARENTS, SWAPPED
from memmlp.motion.clip import Clip, resample
from memmlp.motion.formats.npz import write_clip
from memmlp.motion.importing.import_folder import import_folder
from memmlp.motion.preparing import duplicates
from memmlp.motion.preparing import survey as survey_module
from memmlp.motion.preparing.duplicates import assign_parts
from memmlp.motion.preparing.manifest import STILL, ClipRecord
from memmlp.motion.preparing.splits import Assignment, MixedSplit, SeededSplit
from memmlp.motion.preparing.survey import survey_folder
from memmlp.motion.synthetic import synthesize_clip

CONTENTS = {"a": "x", "b": "y", "c": "x", "d": "x", "e": "y", "f": "z", "g": STILL, "h": STILL}
ACTIVITIES = ("walking", "running", "waving", "sitting")


def records(contents: dict[str, str]) -> list[ClipRecord]:
    return [ClipRecord(name, "", "", "", 0, 9, "", of, 60.0, "kept") for name, of in contents.items()]


def test_training_gives_way_to_validation_and_both_to_testing():
    parts = {"a": "train", "b": "val", "c": "test", "d": "val", "e": "train", "f": "train"}
    kept, gave_way = duplicates.drop_copies_across_parts(
        records(CONTENTS), parts | {"g": "train", "h": "test"}
    )
    assert kept == parts | {"a": None, "d": None, "e": None, "g": "train", "h": "test"}
    assert gave_way == {"a": "c", "d": "c", "e": "b"}
    one = dict.fromkeys(CONTENTS, "train") | {"c": None}
    assert duplicates.drop_copies_across_parts(records(CONTENTS), one) == (one, {})


def test_groups_with_copies_are_merged_although_a_published_list_is_kept():
    groups = {"a": "a", "b": "b", "c": "c", "d": "d", "e": "d", "f": "f", "g": "c", "h": "h"}
    assert duplicates.merge_groups(records(CONTENTS), groups) == {
        "a": "a", "b": "a", "c": "a", "d": "a", "e": "a", "f": "f", "g": "a", "h": "h",
    }  # fmt: skip
    given = Assignment(dict.fromkeys(CONTENTS, "train") | {"c": "test"}, {name: name for name in CONTENTS})
    split = mock.Mock(listed={"CMU": 8}, assign=mock.Mock(return_value=given))
    parts, groups, gave_way = assign_parts(split, records(CONTENTS))
    assert parts == given.parts | {"a": None, "d": None}
    assert gave_way == {"a": "c", "d": "c"}
    assert groups["d"] == "a"
    assert split.assign.call_count == 1


def test_a_copy_leaves_the_limit_of_clips_of_a_group():
    """Twelve takes of ten clips each; one clip of the first take is there again in the second."""
    names = [f"cmu/take{take:02}/{clip}" for take in range(12) for clip in range(10)]
    contents = {name: name for name in names} | {names[10]: names[0]}
    own = SeededSplit(test=0.2, val=0.2, groups=["(take..)/"], per_group=2)
    split = MixedSplit({"cmu": own})
    parts, groups, gave_way = assign_parts(split, records(contents))
    held_out = Counter((groups[name], part) for name, part in parts.items() if part in ("val", "test"))
    assert {part for _, part in held_out} == {"val", "test"}
    assert set(held_out.values()) == {2}
    assert groups[names[10]] == groups[names[0]]
    assert gave_way == {}


@functools.cache
def recorded(activity: str, seed: int = 1, fps: float = 60.0) -> Clip:
    return synthesize_clip(activity, seed, seconds=5.0 if fps == 60 else 2.0, fps=fps)


def cut(clip: Clip, start: int, end: int | None = None) -> Clip:
    return replace(clip, poses=clip.poses[start:end], trans=clip.trans[start:end])


def rounded(clip: Clip) -> Clip:
    """As a text file has it, with three decimals."""
    return replace(clip, poses=clip.poses.round(3), trans=clip.trans.round(3))


def mirrored(clip: Clip) -> Clip:
    """As data sets ship it: left and right joints change places, and rotation vectors keep their x alone."""
    poses = clip.poses[:, list(SWAPPED)] * np.array([1, -1, -1])
    return replace(clip, poses=poses, trans=clip.trans * np.array([-1, 1, 1], np.float32))


def lifted(clip: Clip) -> Clip:
    """As an import that measures another floor height."""
    return replace(clip, trans=clip.trans + np.float32([0, 0, 0.03]))


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
        write_clip(tmp_path / "clips" / "a" / f"{activity}.npz", recorded(activity))
    return tmp_path / "clips"


def write_all(root: Path, change: Callable[[Clip], Clip]) -> dict[str, str]:
    """Write a changed copy of each activity, and return the duplicates that should be found."""
    for activity in ACTIVITIES:
        write_clip(root / "b" / f"{activity}.npz", change(recorded(activity)))
    return {f"b/{activity}": f"a/{activity}" for activity in ACTIVITIES}


@pytest.mark.parametrize(("fps", "change"), [(20.0, lifted), (119.88, mirrored)])
def test_a_copy_at_another_rate_is_found(
    root: Path, monkeypatch: pytest.MonkeyPatch, fps: float, change: Callable[[Clip], Clip]
):
    monkeypatch.setattr(survey_module, "find_shared_stretches", lambda *_: [])
    for activity in ACTIVITIES:
        clip = recorded(activity, fps=120.0)
        write_clip(root / "a" / f"{activity}.npz", clip)
        write_clip(root / "b" / f"{activity}.npz", change(resample(clip, fps)[0]))
    found = survey_folder(root)
    assert found.duplicates == {f"b/{activity}": f"a/{activity}" for activity in ACTIVITIES}
    assert len(found.clips) == 2 * len(ACTIVITIES)


def test_a_clip_that_only_begins_like_another_is_not_a_copy(root: Path, monkeypatch: pytest.MonkeyPatch):
    for name in ("find_shared_stretches", "find_conversions"):
        monkeypatch.setattr(survey_module, name, lambda *_: [])
    clip, run = (cut(recorded(name), 0, 120) for name in ("walking", "running"))
    write_clip(root / "a" / "walking.npz", clip)
    slope = np.linspace(0, 0.1, len(clip))[:, None] * [1, 0, 0]
    for name, other in {
        "turns": replace(clip, poses=np.concatenate([clip.poses[:1], run.poses[1:]])),
        "part": cut(clip, 0, 60),
        "drifts": replace(clip, trans=clip.trans + slope),
    }.items():
        write_clip(root / "b" / f"{name}.npz", resample(other, 30.0)[0])
    assert survey_folder(root).duplicates == {}


@pytest.mark.parametrize("rates", [(120, 60), (60, 180), (120, 180), (60, 30), (60, 25), (100, 60), (60, 60)])
def test_a_noisy_take_is_found_at_another_rate_and_start(tmp_path: Path, rates: tuple[float, float]):
    moving = ("walking", "running", "waving")
    for activity in moving:
        take = synthesize_clip(activity, 1, seconds=3.0, fps=180.0 if 180 in rates else 120.0)
        noise = np.random.default_rng(0).normal(0, 0.003, take.poses.shape)
        take = replace(take, poses=(take.poses + noise).astype(np.float32))
        for folder, start, fps in zip("ab", (0, 1), rates, strict=True):
            write_clip(tmp_path / folder / f"{activity}.npz", resample(cut(take, start), fps)[0])
    expected = {f"b/{activity}": f"a/{activity}" for activity in moving}
    assert survey_folder(tmp_path).duplicates == expected


def between(clip: Clip) -> Clip:
    """Frames halfway between those of a clip."""
    twice = resample(clip, 120.0)[0]
    return replace(twice, poses=twice.poses[1::2], trans=twice.trans[1::2], fps=60.0)


def backwards(clip: Clip) -> Clip:
    return replace(clip, poses=clip.poses[::-1], trans=clip.trans[::-1])


@pytest.mark.parametrize("change", [
    elsewhere, between, lambda clip: backwards(cut(clip, 5)),
    lambda clip: rounded(cut(mirrored(clip), 97, 230)),
])  # fmt: skip
def test_a_clip_that_shares_a_stretch_is_found(root: Path, change: Callable[[Clip], Clip]):
    expected = write_all(root, change)
    assert survey_folder(root).duplicates == expected


def test_repetitions_cuts_and_common_rest_poses_are_different(root: Path):
    recording = synthesize_clip("reaching", 5, seconds=10.0)
    for name, (start, end) in {"first": (0, 300), "second": (300, 600)}.items():
        write_clip(root / f"{name}.npz", cut(recording, start, end))
    for activity in ("walking", "waving"):
        clip = recorded(activity, 2)
        place = np.repeat(clip.trans[:1], 180, 0)
        poses = np.concatenate([np.zeros((180, 22, 3), np.float32), clip.poses])
        late = replace(clip, poses=poses, trans=np.concatenate([place, clip.trans]))
        write_clip(root / f"{activity}_again.npz", late)
    assert survey_folder(root).duplicates == {}


def convert(clip: Clip, seed: int) -> Clip:
    """Turn every joint by a constant of about 10 degrees, and change the size, as other bones do."""
    turns = Rotation.from_rotvec(np.random.default_rng(seed).normal(0, 0.1, (22, 3))).as_matrix()
    local = Rotation.from_rotvec(clip.poses.reshape(-1, 3)).as_matrix().reshape(-1, 22, 3, 3)
    above = np.array([np.eye(3), *(turns[parent] for parent in PARENTS[1:])])
    poses = Rotation.from_matrix((above.swapaxes(-1, -2) @ local @ turns).reshape(-1, 3, 3)).as_rotvec()
    return replace(clip, poses=poses.reshape(-1, 22, 3), trans=1.1 * clip.trans)


@pytest.mark.parametrize("activity", ["walking", "running", "punching"])
def test_conversions_are_copies_and_repetitions_are_not(tmp_path: Path, activity: str):
    clip = synthesize_clip(activity, 1, seconds=6.0, fps=120.0)
    other = convert(clip, 0)
    write_clip(tmp_path / "a.npz", clip)
    write_clip(tmp_path / "other.npz", other)
    late = replace(other, poses=other.poses[37:], trans=other.trans[37:])  # half a frame off at 60 Hz
    write_clip(tmp_path / "late.npz", resample(late, 30.0)[0])
    write_clip(tmp_path / "repetition.npz", convert(synthesize_clip(activity, 2, seconds=6.0), 0))
    assert survey_folder(tmp_path).duplicates == {"late": "a", "other": "a"}


@pytest.mark.slow
def test_two_conversions_of_cmus_takes_are_copies(tmp_path: Path, database: Callable[[str], Path]):
    for form, suffix in (("asfamc", "amc"), ("motionbuilder", "bvh")):
        for path in (database(f"cmu-{form}") / f"cmu-{form}" / "05").glob(f"05_0[1-4].{suffix}"):
            import_folder(path, tmp_path / "clips" / form / path.stem)
    takes = ("05_01", "05_02", "05_03", "05_04")
    expected = {f"motionbuilder/{take}/{take}": f"asfamc/{take}/{take}" for take in takes}
    assert survey_folder(tmp_path / "clips").duplicates == expected
