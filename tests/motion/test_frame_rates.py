"""Rates of recordings: which are known, and which known one is nearest."""

from __future__ import annotations

import pytest

from memmlp.motion.frame_rates import RARE_RATES, USUAL_RATES, is_known_rate, nearest_rate


@pytest.mark.parametrize("rate", [*USUAL_RATES, *RARE_RATES, 23.976, 29.97, 59.94, 119.88, 1 / 0.0083333])
def test_rates_of_cameras_and_of_video_are_known(rate: float):
    assert is_known_rate(rate)


@pytest.mark.parametrize(("time", "usual"), [(0.016, 60), (0.017, 60), (0.008, 120), (0.03, 30), (0.011, 90)])
def test_the_rate_of_a_frame_time_that_was_cut_off_is_none(time: float, usual: float):
    assert not is_known_rate(1 / time)
    assert nearest_rate(1 / time) == usual
