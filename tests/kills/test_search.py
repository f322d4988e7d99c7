"""A search under SIGKILLs: the short form of `memmlp bench chaos-tune`."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest
from command_line import SMALL, run
from kills.storms import forked_controllers


@pytest.mark.slow
def test_every_trial_is_there_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """With two seeds a trial, so that some kills come between a trial's runs, which are short here."""
    chaos = importlib.import_module("memmlp.cli.bench.chaos")  # in its package the name is the command's
    monkeypatch.setattr(chaos, "LONG_PAUSES", (1.0, 4.0))
    forked_controllers(tmp_path, monkeypatch)
    words = ["--trials", "2", "--kills", "3", *SMALL, "search.seeds=2"]
    said = run(tmp_path, "bench", "chaos-tune", *words)
    assert "2 trials with 3 kills" in said
    assert "all trials as they should be: 0 differences" in said
