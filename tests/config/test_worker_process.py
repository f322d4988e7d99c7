"""A worker's process."""

from pathlib import Path
from unittest.mock import Mock

import pytest

from memmlp.config import worker_process
from memmlp.config.worker_process import work


def test_a_worker_without_its_gpu_does_nothing_and_returns_why(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("memmlp.training.devices.describe_missing_gpu", lambda: "torch finds none")
    monkeypatch.setattr(worker_process, "work_on_plan", perform := Mock())
    assert work("plan.json", 1, None, True) == "torch finds none"
    assert not perform.called
    assert work("plan.json", 1, None, False) is None
    assert perform.call_args.args[0] == Path("plan.json")
