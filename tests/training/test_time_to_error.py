"""Trainings in turn are the trainings that they are alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from tiny_tasks import OPTIM, motion_task

from memmlp.runs.run import Run
from memmlp.training.loop import train
from memmlp.training.time_to_error import (
    Learner,
    Validation,
    find_first,
    train_in_turn,
)


def test_trainings_in_turn_are_what_they_are_alone(tmp_path: Path):
    """One has 12 steps and an average, the other 5, so that the first goes on alone."""
    optims = replace(OPTIM, ema=0.9), replace(OPTIM, steps=5, lr=2e-3)
    learners = [Learner(motion_task("own", optim), optim, 3, "answer") for optim in optims]
    assert list(train_in_turn(learners, 2)) == [2, 2, 2, 2, 2, 1, 2, 2, 2]
    for number, (one, optim) in enumerate(zip(learners, optims, strict=True)):
        run = Run(tmp_path / str(number))
        run.folder.mkdir()
        alone = motion_task("own", optim)
        train(alone, optim, run, 3, "alone")
        one.average.put_in_place()
        pairs = zip(one.task.module.parameters(), alone.module.parameters(), strict=True)
        assert all(torch.equal(ours, theirs) for ours, theirs in pairs)
    steps, seconds, errors = zip(*learners[0].validations, strict=True)
    assert steps == (2, 4, 6, 8, 10, 12)
    assert set(errors) == {42.0}
    assert list(seconds) == sorted(seconds)


def test_the_first_validation_with_an_error():
    validations = [Validation(steps, steps / 10, error) for steps, error in ((1, 9.0), (2, 5.0), (3, 4.0))]
    assert find_first(validations, 5.0) == validations[1]
    assert find_first(validations, 3.0) is None
    assert find_first([Validation(1, 0.1, float("nan"))], 3.0) is None
