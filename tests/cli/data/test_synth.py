"""`memmlp data synth` and `data prepare`: what would be ignored, or mixed with what is there, is refused."""

from __future__ import annotations

from pathlib import Path

import pytest
from conftest import one_line


@pytest.mark.slow
def test_clips_are_written_beside_no_others(memmlp, tmp_path: Path):
    words = ["data", "synth", "--out", "clips", "--minutes", "0.05"]
    assert memmlp(*words).code == 0
    before = sorted(path.stat().st_mtime_ns for path in tmp_path.rglob("*.npz"))
    assert one_line(
        memmlp(*words, "--seed", "1"), "--out clips: has clips already", "allowed is a new folder"
    )
    assert sorted(path.stat().st_mtime_ns for path in tmp_path.rglob("*.npz")) == before


def test_a_fraction_for_testing_goes_with_a_seeded_split(memmlp):
    ran = memmlp("data", "prepare", "clips", "--out", "cache", "--split", "s2", "--test", "0.4")
    assert one_line(ran, "--test 0.4: goes with --split seeded; with --split s2 allowed is none")
