"""The training loop, its process killed at unrelated moments."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import torch

from memmlp import checkpoint
from memmlp.runs import Run

CHILD = """
    import sys; sys.path[:0] = [{tests!r}]
    import test_training as t
    from dataclasses import replace
    from pathlib import Path
    from memmlp.runs import Run
    run = Run(Path({folder!r})); run.folder.mkdir(exist_ok=True)
    optim = replace(t.OPTIM, steps=200, checkpoint_every=7)
    t.torch.set_num_threads(1)
    t.train(t.motion_task("own", optim), optim, run, 0, "child")
"""


def child(folder: Path) -> subprocess.Popen:
    code = textwrap.dedent(CHILD).format(tests=str(Path(__file__).parents[1]), folder=str(folder))
    return subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )


def test_kill_9_at_any_moment_then_again_ends_in_the_same_weights(tmp_path: Path):
    """Real processes, killed at three unrelated moments (a write in progress among them by chance)."""
    assert child(tmp_path / "whole").wait() == 0
    broken = Run(tmp_path / "broken")
    for after in (7, 50, 100):  # kill as soon as the checkpoint has passed that step
        process = child(broken.folder)
        while process.poll() is None:
            if broken.checkpoint.exists() and checkpoint.read(broken.checkpoint)[1]["step"] >= after:
                os.kill(process.pid, signal.SIGKILL)
                break
            time.sleep(0.003)
        assert process.wait() == -signal.SIGKILL
    assert child(broken.folder).wait() == 0
    expected, got = (checkpoint.read(run.checkpoint)[0] for run in (Run(tmp_path / "whole"), broken))
    assert expected.keys() == got.keys()
    assert all(torch.equal(expected[name], got[name]) for name in expected)
