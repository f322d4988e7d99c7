"""A run trained by several processes is the run that one process trains with the same whole batch."""

import os
import shutil
import signal
import socket
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import pytest
import torch
from processes import PATIENCE, forked
from tiny_tasks import OPTIM, TASKS, motion_task, weights
from torch import nn

from memmlp.common import distributed
from memmlp.common.errors import InputError
from memmlp.networks import checkpoint, layers
from memmlp.runs.run import Run
from memmlp.training.loop import TrainingTask, check_processes, train
from memmlp.training.optim import Muon, Optim
from memmlp.training.train_network import VQVAETask

STEPS = replace(OPTIM, steps=10, checkpoint_every=4, validate_every=5)
OPTIMS = {"muon": Muon(**asdict(replace(STEPS, ema=0.9)))}
DEATH = 6  # the step at which the second process dies


def optim_of(name: str) -> Optim:
    return OPTIMS.get(name, STEPS)


def precise(name: str) -> TrainingTask:
    """A task in float64: in float32 two trainings differ within tens of steps, by the order of sums."""
    task = TASKS[name](optim=optim_of(name))
    task.module.double()
    task.dataset.frames = task.dataset.frames.double()
    if isinstance(task, VQVAETask):
        task.normalizer.double()
        task.validation.frames = task.validation.frames.double()
    return task


def together(folder: Path, *names: str) -> None:
    """Train tasks in this process, one of several, each in FOLDER/TASK from its checkpoint. In a task named
    die=TASK the second process is killed on the way."""
    distributed.connect("cpu")
    for word in names:
        name = word.removeprefix("die=")
        task = precise(name)
        if name != word and distributed.rank() == 1:
            task.step = dying(task.step, partial(os.kill, os.getpid(), signal.SIGKILL))
        train(task, optim_of(name), Run(folder / name), 0, name)


def dying(step: Callable, die: Callable[[], object]) -> Callable:
    """A step that dies at number DEATH."""

    def last(number: int) -> object:
        if number == DEATH:
            die()
        return step(number)

    return last


NAMES = ("streams", "joint", "avatar_poser", "agrol_diffusion", "muon", "vqvae")
"""Tasks with all that could differ: states, blends, passes, codes that restart, dropout, noise, averages."""


class Kill(Exception):
    """Raised where a process is killed."""


def kill() -> None:
    raise Kill


def train_alone(name: str, folder: Path, die: bool = False) -> Run:
    run, task = Run(folder / name), precise(name)
    run.folder.mkdir(parents=True, exist_ok=True)
    if die:
        task.step = dying(task.step, kill)
    train(task, optim_of(name), run, 0, name)
    return run


def train_together(folder: Path, *names: str) -> list[int]:
    """Train tasks in two processes, and return their exit codes."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    for name in names:
        (folder / name.removeprefix("die=")).mkdir(parents=True, exist_ok=True)
    shared = {"TORCHELASTIC_RUN_ID": "tests", "WORLD_SIZE": "2", "OMP_NUM_THREADS": "1"}
    shared |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    with (
        forked(together, folder, *names, **shared, RANK="0", LOCAL_RANK="0") as first,
        forked(together, folder, *names, **shared, RANK="1", LOCAL_RANK="1") as second,
    ):
        return [first.wait(PATIENCE), second.wait(PATIENCE)]


def difference(one: Run, other: Run) -> float:
    """Return the largest difference between two checkpoints' weights, statistics and moments."""
    ours, theirs = weights(one), weights(other)
    assert ours.keys() == theirs.keys()
    pairs = [(ours[name].double(), theirs[name].double()) for name in ours if ours[name].numel()]
    return max(float((a - b).abs().max()) for a, b in pairs)


@pytest.mark.slow
def test_two_processes_train_the_weights_of_one_and_take_over_from_each_other(tmp_path: Path):
    alone = {name: train_alone(name, tmp_path / "alone") for name in NAMES}
    pair, one_begins, two_begin = tmp_path / "pair", "vqvae", "streams"
    with pytest.raises(Kill):
        train_alone(one_begins, pair, die=True)
    codes = train_together(pair, *(name for name in NAMES if name != two_begin), f"die={two_begin}")
    assert codes[1] == -signal.SIGKILL
    assert codes[0] not in (0, -signal.SIGKILL)
    shutil.copytree(pair / two_begin, tmp_path / "one" / two_begin)
    assert checkpoint.read(pair / two_begin / "checkpoint.safetensors")[1]["step"] == STEPS.checkpoint_every
    again = train_alone(two_begin, tmp_path / "one")
    assert train_together(pair, two_begin) == [0, 0]
    found = {name: difference(run, Run(pair / name)) for name, run in alone.items()}
    found["one after two"] = difference(alone[two_begin], again)
    assert {name for name, worst in found.items() if worst > 1e-9} == set(), found
    for name, run in alone.items():
        assert [m.step for m in run.metrics()] == [m.step for m in Run(pair / name).metrics()]


@pytest.fixture
def two(monkeypatch: pytest.MonkeyPatch) -> None:
    """This process is the second of two, which are not connected."""
    monkeypatch.setattr(distributed, "world_size", lambda: 2)
    monkeypatch.setattr(distributed, "rank", lambda: 1)


def test_rows_draws_and_dropout_of_the_second_of_two(two: None):
    batch = torch.arange(8.0).reshape(4, 2)
    assert torch.equal(distributed.take_local_rows(batch), batch)  # outside of a step
    with distributed.split_batch():
        assert torch.equal(distributed.take_local_rows(batch), batch[2:])
        torch.manual_seed(3)
        rows = distributed.draw_rows(torch.rand_like, batch[2:])
    torch.manual_seed(3)
    assert torch.equal(rows, torch.rand_like(batch)[2:])
    assert torch.equal(distributed.take_local_rows(batch), batch)
    layer, batch = layers.Dropout(0.5), torch.rand(6, 3)
    torch.manual_seed(1)
    expected = layer(batch)
    torch.manual_seed(1)
    with distributed.split_batch():
        assert torch.equal(layer(batch[3:]), expected[3:])
        assert torch.equal(layer.eval()(batch), batch)


def test_a_batch_that_cannot_be_shared_is_refused(two: None):
    task = motion_task()
    with pytest.raises(InputError, match=r"optim.batch or vqvae.batch=5"):
        check_processes(task, replace(STEPS, batch=5), "network")
    check_processes(task, STEPS, "network")


@pytest.mark.parametrize("layer", [nn.Dropout(0.1), nn.BatchNorm1d(3), nn.LSTM(3, 3, 2, dropout=0.1)])
def test_layers_that_would_draw_or_count_by_themselves_are_refused(two: None, layer: nn.Module):
    task = motion_task()
    task.module.add_module("own", layer)
    with pytest.raises(InputError, match=f"{type(layer).__name__} with 2 processes"):
        check_processes(task, STEPS, "network")
    sound = nn.Sequential(layers.Dropout(0.1), nn.Dropout(0.0), nn.LSTM(3, 3))
    assert layers.find_batch_dependent_layers(sound) == []


def test_one_process_shares_nothing(monkeypatch: pytest.MonkeyPatch):
    """Variables that a cluster sets for its own jobs are none of torchrun's."""
    monkeypatch.setenv("WORLD_SIZE", "4")
    monkeypatch.delenv("TORCHELASTIC_RUN_ID", raising=False)
    assert (distributed.world_size(), distributed.rank(), distributed.is_first()) == (1, 0, True)
    value = torch.rand(3)
    with distributed.split_batch():
        assert distributed.take_local_rows(value) is value
        assert distributed.gather_rows(value) is value
        assert distributed.average(value) is value
    assert distributed.broadcast("a") == "a"
