"""The training loop, its process killed at unrelated moments."""

from __future__ import annotations

import signal
import subprocess
import sys
import textwrap
from contextlib import AbstractContextManager
from pathlib import Path

import pytest
import tiny
import torch
from processes import started, until

from memmlp.networks import checkpoint
from memmlp.runs.run import Run
from memmlp.training.loop import train
from memmlp.training.losses import HandPosition, MotionLoss, Uncertainty
from memmlp.training.network import MotionTask
from memmlp.training.optim import Optim
from memmlp.training.rollout import OwnPredictions

CHILD = """
    import sys; sys.path[:0] = [{here!r}, {tests!r}]
    import test_training as t
    from pathlib import Path
    t.whole(Path({folder!r}))
"""


def whole(folder: Path) -> Run:
    """A run of 200 steps brought to its end, in this process."""
    torch.set_num_threads(1)
    optim = Optim(steps=200, batch=4, lr=1e-3, checkpoint_every=7, log_every=4)
    model, run = tiny.model(), Run(folder)
    run.folder.mkdir(exist_ok=True)
    loss = MotionLoss(Uncertainty(), HandPosition(), model.predictor.branches)
    task = MotionTask(model, loss, OwnPredictions(2), tiny.frames(), optim, 0, validate=lambda model: {})
    train(task, optim, run, 0, "whole")
    return run


def child(folder: Path) -> AbstractContextManager[subprocess.Popen]:
    """A process that brings the run to its end."""
    here = Path(__file__).parent
    code = textwrap.dedent(CHILD).format(tests=str(here.parent), here=str(here), folder=str(folder))
    line = [sys.executable, "-c", code]
    return started(line, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def passed(run: Run, step: int) -> bool:
    """Whether the checkpoint is of that step or a later one."""
    return run.checkpoint.exists() and checkpoint.read(run.checkpoint)[1]["step"] >= step


@pytest.mark.slow
def test_kill_9_at_any_moment_then_again_ends_in_the_same_weights(tmp_path: Path):
    """Real processes, killed at three unrelated moments (a write in progress among them by chance)."""
    broken = Run(tmp_path / "broken")
    for after in (7, 50, 100):  # kill as soon as the checkpoint has passed that step
        with child(broken.folder) as process:
            until(lambda step=after: passed(broken, step), f"step {after}", process)
            process.kill()
            assert process.wait() == -signal.SIGKILL
    expected, got = (checkpoint.read(whole(tmp_path / name).checkpoint)[0] for name in ("whole", "broken"))
    assert expected.keys() == got.keys()
    assert all(torch.equal(expected[name], got[name]) for name in expected)
