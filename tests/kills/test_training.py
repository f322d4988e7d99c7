"""The training loop, its process killed at unrelated moments."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import tiny
import torch

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


def child(folder: Path) -> subprocess.Popen:
    here = Path(__file__).parent
    code = textwrap.dedent(CHILD).format(tests=str(here.parent), here=str(here), folder=str(folder))
    return subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )


def test_kill_9_at_any_moment_then_again_ends_in_the_same_weights(tmp_path: Path):
    """Real processes, killed at three unrelated moments (a write in progress among them by chance)."""
    broken = Run(tmp_path / "broken")
    for after in (7, 50, 100):  # kill as soon as the checkpoint has passed that step
        process = child(broken.folder)
        while process.poll() is None:
            if broken.checkpoint.exists() and checkpoint.read(broken.checkpoint)[1]["step"] >= after:
                os.kill(process.pid, signal.SIGKILL)
                break
            time.sleep(0.003)
        assert process.wait() == -signal.SIGKILL
    expected, got = (checkpoint.read(whole(tmp_path / name).checkpoint)[0] for name in ("whole", "broken"))
    assert expected.keys() == got.keys()
    assert all(torch.equal(expected[name], got[name]) for name in expected)
