"""`torchrun -m memmlp train`: one run by two processes."""

import os
from contextlib import ExitStack
from pathlib import Path

import pytest
import torch
from command_line import TINY, in_folder, run
from processes import forked, until

from memmlp.networks import checkpoint
from memmlp.runs.lookup import list_runs

STANDING = "env -0 > rank.part$RANK && mv rank.part$RANK rank$RANK; until [ -e ended ]; do sleep 0.1; done"
"""What torchrun starts twice: a shell that writes its environment down, and stays until all is done."""


def torchrun(folder: Path) -> None:
    """Torchrun itself, which keeps the store through which its processes meet."""
    from torch.distributed.run import main

    os.chdir(folder)
    main(["--standalone", "--nproc-per-node", "2", "--no-python", "sh", "-c", STANDING])


def environment(file: Path) -> dict[str, str]:
    """The environment that torchrun gave one of its processes."""
    return dict(word.split("=", 1) for word in file.read_text().split("\0") if word)


@pytest.mark.long
def test_two_processes_make_the_run_of_one(tmp_path: Path):
    """Its VQ-VAE and its network; the first process alone writes and evaluates (and would deploy). The
    processes have torchrun's environments, and are forked, since each would import torch for seconds."""
    ranks = [tmp_path / f"rank{rank}" for rank in range(2)]
    said = [tmp_path / f"said{rank}" for rank in range(2)]
    # Of less motion, steps depend on the order of sums: gradients of what never moves are of rounding alone.
    words = ["train", *TINY, "data.synth.minutes=0.2", "export.graph=off"]
    alone = tmp_path / "alone"
    alone.mkdir()
    run(alone, *words)
    with forked(torchrun, tmp_path) as launcher, ExitStack() as stack:
        until(lambda: all(file.exists() for file in ranks), "both are started", launcher)
        both = []
        for file, rank in zip(said, ranks, strict=True):
            file.touch()
            given = {**environment(rank), "OMP_NUM_THREADS": "1"}
            both.append(stack.enter_context(forked(in_folder, tmp_path, *words, said=str(file), **given)))
        codes = [process.wait() for process in both]
        (tmp_path / "ended").touch()
        assert launcher.wait() == 0
    text = "".join(file.read_text() for file in said)
    assert codes == [0, 0], text
    assert text.count("MPJPE") == 1
    runs = {run.id: run for run in list_runs(tmp_path / "outputs")}
    assert runs.keys() == {run.id for run in list_runs(alone / "outputs")}
    for one in list_runs(alone / "outputs"):
        other = runs[one.id]
        assert (one.manifest["processes"], other.manifest["processes"]) == (1, 2)
        assert [m.step for m in one.metrics()] == [m.step for m in other.metrics()]
        stages = [attempt["stage"] for attempt in one.manifest["attempts"]]
        assert [attempt["stage"] for attempt in other.manifest["attempts"]] == stages
        assert other.verify() == []
        ours, theirs = checkpoint.read(one.model)[0], checkpoint.read(other.model)[0]
        for name, tensor in ours.items():
            torch.testing.assert_close(tensor, theirs[name], atol=1e-4, rtol=1e-3)


def test_what_several_processes_cannot_do_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for name, value in {"TORCHELASTIC_RUN_ID": "tests", "WORLD_SIZE": "2", "RANK": "0"}.items():
        monkeypatch.setenv(name, value)
    for words, line in ((["runs", "list"], "memmlp train"), (["train", "-m", "seed=0,1"], "one run")):
        said = run(tmp_path, *words, code=2)
        assert said.startswith("memmlp: torchrun: ")
        assert line in said
        assert said.count("\n") == 1
