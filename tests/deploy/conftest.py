"""What tests of deployments share."""

from __future__ import annotations

import pytest


@pytest.fixture
def small_yardstick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps are timed in turn with a computation that is over at once, not with 86 M multiply-adds."""
    monkeypatch.setattr("memmlp.deploy.latency.YARDSTICK_SHAPE", (2, 8, 1))
