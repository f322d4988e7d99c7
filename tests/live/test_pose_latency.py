"""The time of a whole pose."""

import pytest

from memmlp.live.pose_latency import measure_pose_times

pytestmark = pytest.mark.slow


def test_a_whole_pose_is_timed(step_files):
    file = step_files("no_memory")
    found = measure_pose_times(file, 1)
    assert 0 < found["pose_median_ms"] <= found["pose_p95_ms"]
    assert 0 < found["pose_core_share"] < 1.01
