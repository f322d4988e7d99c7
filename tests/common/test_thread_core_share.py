"""The share of a measurement in which its thread had a core."""

import pytest

from memmlp.common import thread_core_share


def test_a_share_by_clocks_of_the_tests_own(monkeypatch: pytest.MonkeyPatch):
    clocks = {"perf_counter": 100.0, "thread_time": 3.0}
    for name in clocks:
        monkeypatch.setattr(thread_core_share.time, name, lambda name=name: clocks[name])
    clock = thread_core_share.CoreClock()
    clocks |= {"perf_counter": 108.0, "thread_time": 5.0}
    assert clock.share == 0.25
