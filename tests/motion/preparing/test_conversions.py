"""Conversions of one take are copies, and repetitions by one person are not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from memmlp.motion.body import PARENTS
from memmlp.motion.clip import Clip, resample
from memmlp.motion.formats.npz import write_clip
from memmlp.motion.importing.import_folder import import_folder
from memmlp.motion.preparing.conversions import BONES, mark_turns
from memmlp.motion.preparing.survey import survey_folder
from memmlp.motion.synthetic import synthesize_clip


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


def test_a_limb_that_moves_otherwise_is_another_take(tmp_path: Path):
    clip, other = (synthesize_clip(activity, 1, seconds=6.0) for activity in ("walking", "punching"))
    poses = clip.poses.copy()
    poses[:, BONES[1:]] = other.poses[:, BONES[1:]]
    write_clip(tmp_path / "a.npz", clip)
    write_clip(tmp_path / "b.npz", replace(clip, poses=poses))
    assert survey_folder(tmp_path).duplicates == {}


def test_short_and_still_clips_have_no_marks():
    clip = synthesize_clip("walking", 1, seconds=6.0)
    for frames in (1, 2, 61):
        assert (
            len(mark_turns(replace(clip, poses=clip.poses[:frames], trans=clip.trans[:frames])).frames) == 0
        )
    assert len(mark_turns(replace(clip, poses=np.zeros_like(clip.poses))).frames) == 0


@pytest.mark.slow
def test_two_conversions_of_cmus_takes_are_copies(tmp_path: Path, database: Callable[[str], Path]):
    for form, suffix in (("asfamc", "amc"), ("motionbuilder", "bvh")):
        for path in (database(f"cmu-{form}") / f"cmu-{form}" / "05").glob(f"05_0[1-4].{suffix}"):
            import_folder(path, tmp_path / "clips" / form / path.stem)
    takes = ("05_01", "05_02", "05_03", "05_04")
    expected = {f"motionbuilder/{take}/{take}": f"asfamc/{take}/{take}" for take in takes}
    assert survey_folder(tmp_path / "clips").duplicates == expected
