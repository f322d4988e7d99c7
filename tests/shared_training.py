"""Trainings that tests have done by processes of their own."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

import torch
from tiny_tasks import OPTIM, TASKS, motion_task

from memmlp.common import distributed
from memmlp.runs.run import Run
from memmlp.training.loop import TrainingTask, train
from memmlp.training.optim import Muon, Optim, ScheduleFree
from memmlp.training.train_vqvae import VQVAETask

STEPS = replace(OPTIM, steps=24, checkpoint_every=10, validate_every=12)
OPTIMS = {
    "muon": Muon(**asdict(replace(STEPS, ema=0.9))),
    "schedule_free": ScheduleFree(**asdict(STEPS)),
}
DEATH = 14  # the step at which the second process dies


def optim_of(name: str) -> Optim:
    """How a task is optimised."""
    return OPTIMS.get(name, STEPS)


def precise(name: str) -> TrainingTask:
    """A task in float64: in float32 the order of sums alone sets two trainings apart within tens of steps."""
    task = TASKS[name](optim=optim_of(name))
    task.module.double()
    task.dataset.frames = task.dataset.frames.double()
    if isinstance(task, VQVAETask):
        task.normalizer.double()
        task.validation.frames = task.validation.frames.double()
    return task


def together(folder: Path, *names: str) -> None:
    """Train tasks in this process, one of several.

    Each task is trained in FOLDER/TASK, from the checkpoint that is there. In the one that is named last as
    die=TASK the second process is killed on the way.
    """
    distributed.connect("cpu")
    for word in names:
        name = word.removeprefix("die=")
        task = precise(name)
        if name != word and distributed.rank() == 1:
            task.step = dying(task.step, partial(os.kill, os.getpid(), signal.SIGKILL))
        train(task, optim_of(name), Run(folder / name), 0, name)


def dying(step: Callable, die: Callable[[], object]) -> Callable:
    """A step that dies at its time."""

    def last(number: int) -> object:
        if number == DEATH:
            die()
        return step(number)

    return last


def alone(folder: Path) -> Run:
    """Bring a run of 200 steps to its end."""
    torch.set_num_threads(1)
    optim = replace(OPTIM, steps=200, checkpoint_every=7)
    task, run = motion_task(optim=optim), Run(folder)
    run.folder.mkdir(exist_ok=True)
    train(task, optim, run, 0, "whole")
    return run
