"""`memmlp bench loggers` times both ways and says what it found."""

from __future__ import annotations

import re

import pytest
from conftest import Memmlp

pytestmark = pytest.mark.slow


def test_a_ratio_of_a_training_that_is_shown_in_event_files(memmlp: Memmlp):
    pytest.importorskip("tensorboardX")
    words = ("profile=tiny", "data.synth.minutes=0.2", "threads=1", "loggers=tensorboard")
    ran = memmlp("bench", "loggers", "--blocks", "4", "--steps", "1", *words)
    assert ran.code == 0, ran.err
    (ratio,) = re.findall(r"^ratio ([\d.]+) \(half of 2 pairs", ran.out, re.MULTILINE)
    assert float(ratio) > 0
