"""The weights with the lowest validation error are kept, also after a kill."""

from dataclasses import replace

import pytest
import torch
from tiny_tasks import OPTIM, motion_task

from memmlp.common.errors import InputError
from memmlp.runs.run import Run
from memmlp.training.loop import train

ERRORS = {2: 9.0, 4: 5.0, 6: float("nan"), 8: 7.0}
BEST = replace(OPTIM, steps=8, validate_every=2, checkpoint_every=3, best_by="rotation")


class Kill(Exception):
    """Raised where a process is killed."""


def task_with_errors(snapshots: dict, start: int = 0, killed_at: int | None = None):
    """A task whose validations have the errors above, with copies of the weights at each."""
    task, count = motion_task(), iter(step for step in ERRORS if step > start)

    def validate(model):
        step = next(count)
        snapshots[step] = {name: one.clone() for name, one in model.state_dict().items()}
        if step == killed_at:
            raise Kill
        return {"rotation MPJPE": ERRORS[step]}

    task._validate = validate
    return task


def assert_kept(task, run: Run, snapshots: dict) -> None:
    assert run.manifest["best_step"] == 4
    assert run.kept_validation.values == {"rotation MPJPE": 5.0}
    assert all(torch.equal(one, snapshots[4][name]) for name, one in task.model.state_dict().items())


def test_the_best_weights_are_kept(tmp_path):
    snapshots: dict = {}
    task, run = task_with_errors(snapshots), Run(tmp_path)
    train(task, BEST, run, 0, "it")
    assert_kept(task, run, snapshots)
    assert not all(torch.equal(snapshots[4][name], one) for name, one in snapshots[8].items())


def test_a_resumed_training_keeps_the_same_weights(tmp_path):
    snapshots: dict = {}
    with pytest.raises(Kill):
        train(task_with_errors(snapshots, killed_at=8), BEST, Run(tmp_path), 0, "killed")
    task = task_with_errors({}, start=6)  # its checkpoint is of step 6
    train(task, BEST, Run(tmp_path), 0, "again")
    assert_kept(task, Run(tmp_path), snapshots)


def test_without_a_branch_the_last_weights_are_kept(tmp_path):
    snapshots: dict = {}
    task, run = task_with_errors(snapshots), Run(tmp_path)
    train(task, replace(BEST, best_by=None), run, 0, "it")
    assert run.kept_validation.step == 8
    assert all(torch.equal(one, snapshots[8][name]) for name, one in task.model.state_dict().items())


def test_a_branch_that_is_not_validated_is_refused(tmp_path):
    with pytest.raises(InputError, match="best_by: 'position MPJPE' is not validated"):
        train(task_with_errors({}), replace(BEST, best_by="position"), Run(tmp_path), 0, "it")
