"""A first frame that is no motion is told by how far it is from the next."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from bvh_samples import performed

from memmlp.motion.importing.calibration_frame import JUMP, MAYBE, first_step
from memmlp.motion.importing.skeleton_map import load_skeleton
from memmlp.motion.synthetic import synthesize_clip


@pytest.mark.parametrize("activity", ["walking", "running", "waving", "punching"])
def test_a_t_pose_before_the_motion_is_a_far_step_and_motion_is_none(activity: str):
    sample = performed(load_skeleton("cmu_daz"), synthesize_clip(activity, 1, seconds=2.0))
    assert first_step(sample.hierarchy()) > JUMP
    assert first_step(replace(sample, values=sample.values[1:]).hierarchy()) < MAYBE


def test_what_is_short_or_hardly_moves_has_none():
    sample = performed(load_skeleton("cmu_daz"), synthesize_clip("walking", 1, seconds=2.0))
    assert first_step(replace(sample, values=sample.values[:3]).hierarchy()) == 0.0
    nearly = np.repeat(sample.values[5:6], 9, 0)
    nearly[0, 8] += 0.5
    assert first_step(replace(sample, values=nearly).hierarchy()) == 0.0
