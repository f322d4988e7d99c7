"""`memmlp train`: what its jobs leave to each other."""

from __future__ import annotations

import pytest
import torch

from memmlp.cli.train import train


def test_threads_that_one_job_asks_for_are_not_those_of_the_next(monkeypatch: pytest.MonkeyPatch):
    before, used = torch.get_num_threads(), []
    monkeypatch.setattr("memmlp.config.build.build_experiment", lambda cfg: cfg)
    monkeypatch.setattr(
        "memmlp.pipeline.run_in_processes.run_in_processes", lambda _: used.append(torch.get_num_threads())
    )
    try:
        train(["-m", f"threads=0,{before + 1},0"])
    finally:
        torch.set_num_threads(before)
    assert used == [before, before + 1, before]
