"""A search under SIGKILLs: a short form of tests/benchmarks/chaos.py."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from benchmarks import chaos
from command_line import SMALL
from kills.storms import forked_controllers


@pytest.mark.slow
def test_every_trial_is_there_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """With two seeds a trial, so that some kills come between a trial's runs, which are short here."""
    monkeypatch.setattr(chaos, "LONG_PAUSES", (1.0, 4.0))
    forked_controllers(tmp_path, monkeypatch)
    assert chaos.search_storm(2, 3, 1, random.Random(0), [*SMALL, "search.seeds=2"]) == []
