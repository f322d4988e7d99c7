"""Trainings that processes of tests share."""

import os
import signal
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

from tiny_tasks import OPTIM, TASKS

from memmlp.common import distributed
from memmlp.runs.run import Run
from memmlp.training.loop import TrainingTask, train
from memmlp.training.optim import Muon, Optim, ScheduleFree
from memmlp.training.train_network import VQVAETask

STEPS = replace(OPTIM, steps=14, checkpoint_every=6, validate_every=7)
OPTIMS = {"muon": Muon(**asdict(replace(STEPS, ema=0.9))), "schedule_free": ScheduleFree(**asdict(STEPS))}
DEATH = 9  # the step at which the second process dies


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
    """Train tasks in this process, one of several, each in FOLDER/TASK from its checkpoint.

    In a task named die=TASK the second process is killed on the way.
    """
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
