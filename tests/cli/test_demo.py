"""`memmlp demo` says what it does where no terminal shows progress bars."""

from __future__ import annotations

import pytest
from command_line import TINY


@pytest.mark.slow
def test_each_stage_has_a_line_without_a_terminal(memmlp):
    ran = memmlp("demo", *TINY)
    assert ran.code == 0
    stages = [line.partition(":")[0] for line in ran.err.splitlines()]
    assert stages == ["data", "VQ-VAE", "network", "evaluation", "deployment"]
    assert "the demo took" in ran.out
