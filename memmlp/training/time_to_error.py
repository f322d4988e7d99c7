"""How soon trainings reach an error: they take turns, so that a busy machine slows all of them equally."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from memmlp.training.loop import TrainingTask, seed_step, train_step, validate
from memmlp.training.optim import Optim


class Validation(NamedTuple):
    """The state of a training at a validation.

    Attributes:
        steps: how many steps had been taken.
        seconds: processor time of these steps, of all threads, in seconds, without validations.
        error: the validation's error.
    """

    steps: int
    seconds: float
    error: float


class Learner:
    """A training in memory that runs piece by piece, with the same steps as `memmlp.training.loop.train`.

    Args:
        task: what to train.
        optim: steps and learning rates; its intervals have no effect.
        seed: the seed of all steps.
        error: the name of the error among the task's validation values.
    """

    def __init__(self, task: TrainingTask, optim: Optim, seed: int, error: str):
        self.task, self.optim, self.seed, self.error = task, optim, seed, error
        self.optimiser = optim.build(task.parameter_groups())
        self.average = optim.make_average(task.module, self.optimiser)
        self.steps, self.seconds = 0, 0.0
        self.validations: list[Validation] = []

    @property
    def done(self) -> bool:
        """Whether all steps have been taken."""
        return self.steps >= self.optim.steps

    def take(self, steps: int) -> None:
        """Take the given number of steps, or as many as are left."""
        start = time.process_time()
        for step in range(self.steps, min(self.steps + steps, self.optim.steps)):
            seed_step(self.seed, step)
            train_step(self.task, self.optim, self.optimiser, step)
            self.average.update(step + 1)
            self.steps = step + 1
        self.seconds += time.process_time() - start

    def advance(self, steps: int) -> None:
        """Take the given number of steps, or as many as are left, and validate."""
        self.take(steps)
        error = validate(self.task, self.average)[self.error]
        self.validations.append(Validation(self.steps, self.seconds, error))


def train_in_turn(learners: Sequence[Learner], every: int) -> Iterator[int]:
    """Train all learners to their ends, in turn, in pieces of `every` steps; yield each piece's steps.

    The order is reversed after each round, so that no learner is always the first.
    """
    order = list(learners)
    while unfinished := [one for one in order if not one.done]:
        for one in unfinished:
            before = one.steps
            one.advance(every)
            yield one.steps - before
        order.reverse()


def find_first(validations: Sequence[Validation], error: float) -> Validation | None:
    """Return the first validation whose error is at most `error`; None if no validation reaches it."""
    return next((one for one in validations if one.error <= error), None)
