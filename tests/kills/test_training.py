"""The training loop, its process killed at unrelated moments."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
import torch
from processes import forked, until
from shared_training import alone

from memmlp.networks import checkpoint
from memmlp.runs.run import Run


def passed(run: Run, step: int) -> bool:
    """Whether the checkpoint is of that step or a later one."""
    return run.checkpoint.exists() and checkpoint.read(run.checkpoint)[1]["step"] >= step


@pytest.mark.slow
def test_kill_9_at_any_moment_then_again_ends_in_the_same_weights(tmp_path: Path):
    """Real processes, killed at three unrelated moments (a write in progress among them by chance)."""
    broken = Run(tmp_path / "broken")
    for after in (7, 50, 100):  # kill as soon as the checkpoint has passed that step
        with forked(alone, broken.folder) as process:
            until(lambda step=after: passed(broken, step), f"step {after}", process)
            process.kill()
            assert process.wait() == -signal.SIGKILL
    expected, got = (checkpoint.read(alone(tmp_path / name).checkpoint)[0] for name in ("whole", "broken"))
    assert expected.keys() == got.keys()
    assert all(torch.equal(expected[name], got[name]) for name in expected)
