"""The time of a whole pose."""

import pytest

from memmlp.live.pose_latency import alternate, measure_pose
from memmlp.live.stream import Stream

pytestmark = pytest.mark.slow


def test_a_whole_pose_is_timed(step_files):
    file = step_files("no_memory")
    found = measure_pose(file, 1)
    assert 0 < found["pose_median_ms"] <= found["pose_p95_ms"]
    stream = Stream(file)
    both = alternate(stream, stream.network, 5)
    assert both.shape == (5, 2)
    assert (both > 0).all()
