"""Dynamics: wrong frame rates and exchanged legs are named, and sound motion is not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from memmlp.motion.body import JOINTS
from memmlp.motion.clip import Clip
from memmlp.motion.formats.npz import read_clip
from memmlp.motion.importing.import_folder import ImportSettings, import_folder
from memmlp.motion.plausibility import find_faults
from memmlp.motion.synthetic import synthesize_clip

SALSA = Path(__file__).parents[3] / "shared" / "data" / "cmu" / "salsa" / "05.bvh"
LEFT, RIGHT = (
    [JOINTS.index(f"{s}_{j}") for j in ("hip", "knee", "ankle", "foot")] for s in ("left", "right")
)


def exchange_legs(clip: Clip) -> Clip:
    poses = clip.poses.copy()
    poses[:, LEFT + RIGHT] = clip.poses[:, RIGHT + LEFT]
    return replace(clip, poses=poses)


def turn_legs(clip: Clip) -> Clip:
    """Turn the legs about the vertical axis, as in a file with exchanged hips."""
    poses = clip.poses.copy()
    poses[:, [LEFT[0], RIGHT[0]]] = [0, np.pi, 0]
    return replace(clip, poses=poses)


@pytest.mark.parametrize(
    ("activity", "change", "said"),
    [
        ("walking", lambda clip: replace(clip, fps=120.0), "so the frame rate 120 Hz may be about twice"),
        ("running", lambda clip: replace(clip, fps=120.0), "faster than people step"),
        ("walking", lambda clip: replace(clip, fps=15.0), "slower than people step"),
        ("jumping", lambda clip: replace(clip, fps=120.0), "times the acceleration of gravity"),
        ("jumping", lambda clip: replace(clip, fps=30.0), "too low"),
        ("walking", exchange_legs, "left and right legs may be swapped"),
        ("walking", turn_legs, "the feet point backward relative to the pelvis"),
    ],
)
def test_a_fault_is_named_and_the_sound_clip_is_not(activity: str, change, said: str):
    clip = synthesize_clip(activity, 1, seconds=8.0)
    assert list(find_faults(clip)) == []
    assert said in "; ".join(find_faults(change(clip)))


def test_a_rate_that_is_a_multiple_of_60_hz_is_checked_alike():
    clip = synthesize_clip("walking", 1, seconds=8.0, fps=120.0)
    assert list(find_faults(clip)) == []
    assert "twice the true rate" in "; ".join(find_faults(replace(clip, fps=240.0)))


@pytest.mark.skipif(not SALSA.is_file(), reason="needs cmu/salsa/05.bvh, which is not part of the project")
def test_the_header_of_salsa_is_wrong(tmp_path: Path):
    import_folder(SALSA, tmp_path / "header", ImportSettings(fps={"": 120.0}))
    import_folder(SALSA, tmp_path / "true")
    assert "twice the true rate" in "; ".join(find_faults(read_clip(tmp_path / "header" / "05.npz", "05")))
    assert list(find_faults(read_clip(tmp_path / "true" / "05.npz", "05"))) == []
