"""`memmlp bench tracking` times both ways and says what it found."""

from __future__ import annotations

import re

import pytest
from conftest import Memmlp

pytestmark = pytest.mark.slow


def test_ratios_of_a_training_that_is_shown_in_event_files(memmlp: Memmlp):
    pytest.importorskip("tensorboardX")
    words = ("profile=tiny", "data.synth.minutes=0.2", "threads=1", "tracking=tensorboard")
    ran = memmlp("bench", "tracking", "--rounds", "1", "--steps", "3", *words)
    assert ran.code == 0, ran.err
    ratios = re.findall(r"without, +[\d.]+ with: ratio ([\d.]+)", ran.out)
    assert len(ratios) == 2
    assert all(float(ratio) > 0 for ratio in ratios)
