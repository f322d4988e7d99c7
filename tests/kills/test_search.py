"""A search under SIGKILLs: the short form of `memmlp bench chaos-tune`."""

from __future__ import annotations

from pathlib import Path

from command_line import run


def test_every_trial_is_there_once(tmp_path: Path):
    said = run(tmp_path, "bench", "chaos-tune", "--trials", "3", "--kills", "5", "data.synth.minutes=0.2")
    assert "3 trials with 5 kills" in said
    assert "all trials as they should be: 0 differences" in said
