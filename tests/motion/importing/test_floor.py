"""The floor under people who stand, climb, jump, lie and fly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from memmlp.motion.body import JOINTS, builtin_rest_joints
from memmlp.motion.clip_kinematics import clip_kinematics
from memmlp.motion.importing.floor import find_floor
from memmlp.motion.importing.skeleton_map import Z_UP
from memmlp.motion.synthetic import synthesize_clip

REST = builtin_rest_joints()
FEET = [JOINTS.index("left_foot"), JOINTS.index("right_foot")]


def standing(frames: int) -> np.ndarray:
    """Positions (N, 22, 3) of a person who stands still, the toe joints 2 cm over the floor."""
    positions = REST @ Z_UP.T
    return np.tile(positions + np.array([0, 0, 0.02 - positions[FEET[0], 2]]), (frames, 1, 1))


@pytest.mark.parametrize("activity", ["walking", "running", "jumping", "squatting", "sitting"])
@pytest.mark.parametrize("height", [0.0, 1.3, -0.4])
def test_the_floor_of_people(activity: str, height: float) -> None:
    clip = synthesize_clip(activity, 2, seconds=4.0)
    positions = clip_kinematics(replace(clip, poses=clip.poses.astype(float)), REST)[1]
    found = find_floor(positions + np.array([0, 0, height]), 60.0)
    assert found == pytest.approx(height, abs=0.02)


def test_the_lowest_step_of_stairs() -> None:
    positions = standing(400)
    positions[..., 2] += np.repeat([0.0, 0.2, 0.4, 0.6], 100)[:, None]
    assert find_floor(positions, 60.0) == pytest.approx(0.0, abs=1e-9)
    assert find_floor(positions[::-1], 60.0) == pytest.approx(0.0, abs=1e-9)


def test_a_jump_does_not_raise_the_floor() -> None:
    positions = standing(100)
    positions[20:80, :, 2] += 0.6 * np.sin(np.linspace(0, np.pi, 60))[:, None]
    assert find_floor(positions, 60.0) == pytest.approx(0.0, abs=0.01)


def test_a_few_frames_below_the_floor_are_noise() -> None:
    positions = standing(200)
    positions[50:54, FEET, 2] -= 0.3
    assert find_floor(positions, 60.0) == pytest.approx(0.0, abs=1e-9)


def test_who_lies_is_on_the_floor() -> None:
    """On the back, the toes up: the floor isn't below the toes but below the back."""
    lying = REST  # the head along y, the face up
    positions = np.tile(lying + np.array([0, 0, 0.1 - lying[:, 2].min()]), (100, 1, 1))
    found = find_floor(positions, 60.0)
    assert found is not None
    assert found <= 0.1


def test_no_floor_without_contact() -> None:
    positions = standing(100)
    assert find_floor(positions[:1], 60.0) is None
    assert find_floor(positions[:5], 60.0) is None
    positions[..., 2] += np.arange(100)[:, None] / 60
    assert find_floor(positions, 60.0) is None
