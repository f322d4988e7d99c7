"""`torchrun -m memmlp train`: one run by two processes."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest
import torch
from command_line import TINY, run
from processes import finished

from memmlp.networks import checkpoint
from memmlp.runs.lookup import list_runs

TORCHRUN = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
ROOT = Path(__file__).parent.parent.parent


@pytest.mark.slow
def test_two_processes_make_the_run_of_one(tiny_home: Path, tmp_path: Path):
    """Its VQ-VAE and its network; the first process alone writes and evaluates (and would deploy)."""
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
    ran = finished(
        [*TORCHRUN, "-m", "memmlp", "train", *TINY, "export.graph=off"], cwd=tmp_path, env=environment
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert ran.stdout.count("MPJPE") == 1
    runs = {run.id: run for run in list_runs(tmp_path / "outputs")}
    assert runs.keys() == {run.id for run in list_runs(tiny_home / "outputs")}
    for one in list_runs(tiny_home / "outputs"):
        other = runs[one.id]
        assert (one.manifest["processes"], other.manifest["processes"]) == (1, 2)
        assert [m.step for m in one.metrics()] == [m.step for m in other.metrics()]
        stages = [attempt["stage"] for attempt in one.manifest["attempts"]]
        own = [stage for stage in stages if stage != "deployment"]
        assert [attempt["stage"] for attempt in other.manifest["attempts"]] == own
        assert other.verify() == []
        ours, theirs = checkpoint.read(one.model)[0], checkpoint.read(other.model)[0]
        for name, tensor in ours.items():
            torch.testing.assert_close(tensor, theirs[name], atol=1e-4, rtol=1e-3)


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["runs", "list"], "torchrun: allowed are several processes for memmlp train alone"),
        (["train", "-m", "seed=0,1"], "torchrun: several processes train one run; allowed is no multirun"),
    ],
)
def test_what_several_processes_cannot_do_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], line: str
):
    for name, value in {"TORCHELASTIC_RUN_ID": "tests", "WORLD_SIZE": "2", "RANK": "0"}.items():
        monkeypatch.setenv(name, value)
    said = run(tmp_path, *words, code=2)
    assert line in said
    assert said.count("\n") == 1
