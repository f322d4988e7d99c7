"""The whole of `memmlp train`, its process killed at unrelated moments."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
from command_line import TINY, in_folder, run
from processes import forked, until

from memmlp.runs.lookup import list_runs
from memmlp.runs.run import Run

MOMENTS = (
    "data/**/*.npz",  # the first clip of the data is there
    "runs/*/checkpoint.safetensors",  # the VQ-VAE is being trained
    "runs/*/evaluations/*.json",  # the network is evaluated in one mode, and about to be in the other
    "runs/*/deployments/*/step.onnx",  # it is exported, and about to be timed
)


@pytest.mark.slow
def test_kill_9_then_again_gives_the_same_model(tiny_home: Path, tmp_path: Path):
    """The whole command killed as soon as it comes to each moment, and then let finish."""
    for moment in MOMENTS:
        with forked(in_folder, tmp_path, "train", *TINY) as process:
            until(lambda at=moment: list((tmp_path / "outputs").glob(at)), moment, process)
            process.kill()
            assert process.wait() == -signal.SIGKILL
    run(tmp_path, "train", *TINY)
    whole = next(made for made in list_runs(tiny_home / "outputs") if "window" in made.results)
    killed = Run.of(tmp_path / "outputs", whole.id)
    assert killed.done
    assert killed.model.read_bytes() == whole.model.read_bytes()
    rotation = killed.results["stream"]["rotation"]
    assert rotation == pytest.approx(whole.results["stream"]["rotation"], rel=1e-6)
