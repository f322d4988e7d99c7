"""The share of a measurement in which its thread had a core."""

import pytest

from memmlp.common import core_share_used


def test_a_share_by_clocks_of_the_tests_own(monkeypatch: pytest.MonkeyPatch):
    clocks = {"perf_counter": 100.0, "thread_time": 3.0}
    for name in clocks:
        monkeypatch.setattr(core_share_used.time, name, lambda name=name: clocks[name])
    clock = core_share_used.CoreClock()
    clocks |= {"perf_counter": 108.0, "thread_time": 5.0}
    assert clock.share == 0.25
