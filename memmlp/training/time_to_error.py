"""How soon trainings reach an error: several of them in turn, so that a busy machine is fair to all."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from memmlp.training.loop import TrainingTask, seed_step, train_step, validate
from memmlp.training.optim import Optim


class Validation(NamedTuple):
    """What was known at a validation.

    Attributes:
        steps: how many steps were taken.
        seconds: the processor's time that these steps took, seconds; validations don't count.
        error: the validation's error.
    """

    steps: int
    seconds: float
    error: float


class Learner:
    """A training in memory that goes on piece by piece. Its steps are those of `memmlp.training.loop.train`.

    Args:
        task: what to train.
        optim: steps and learning rates; its intervals do nothing.
        seed: the seed of all steps.
        error: the name of the error among the task's validation values.
    """

    def __init__(self, task: TrainingTask, optim: Optim, seed: int, error: str):
        self.task, self.optim, self.seed, self.error = task, optim, seed, error
        self.optimiser = optim.build(task.parameter_groups())
        self.average = optim.average(task.module, self.optimiser)
        self.steps, self.seconds = 0, 0.0
        self.validations: list[Validation] = []

    @property
    def done(self) -> bool:
        """Whether all steps were taken."""
        return self.steps >= self.optim.steps

    def take(self, steps: int) -> None:
        """Take so many steps, no more than are left."""
        start = time.process_time()
        for step in range(self.steps, min(self.steps + steps, self.optim.steps)):
            seed_step(self.seed, step)
            train_step(self.task, self.optim, self.optimiser, step)
            self.average.update(step + 1)
            self.steps = step + 1
        self.seconds += time.process_time() - start

    def advance(self, steps: int) -> None:
        """Take so many steps, no more than are left, and validate."""
        self.take(steps)
        error = validate(self.task, self.average)[self.error]
        self.validations.append(Validation(self.steps, self.seconds, error))


def in_turn(learners: Sequence[Learner], every: int) -> Iterator[int]:
    """Train all to their ends in pieces of `every` steps, each after the other, and yield a piece's steps.

    The order is turned round after each turn, so that none is always the first.
    """
    order = list(learners)
    while unfinished := [one for one in order if not one.done]:
        for one in unfinished:
            before = one.steps
            one.advance(every)
            yield one.steps - before
        order.reverse()


def first_at(validations: Sequence[Validation], error: float) -> Validation | None:
    """Return the first validation whose error is at most `error`; None if there is none."""
    return next((one for one in validations if one.error <= error), None)
