"""The training loop: learning, resuming bit for bit after a kill, stopping at NaN; checkpoints."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tiny_tasks import OPTIM, TASKS, motion_task, weights

from memmlp.common.errors import InputError, RunStopped, TrainingDiverged
from memmlp.common.processes import UsageTimer
from memmlp.networks import checkpoint
from memmlp.runs.run import Run
from memmlp.training.loop import train
from memmlp.training.train_network import compute_perplexity


class Kill(Exception):
    """Raised where a process is killed."""


SHORT = replace(OPTIM, steps=8, checkpoint_every=3)


@pytest.mark.slow
@pytest.mark.parametrize("make", ["streams", "rpm", "lower_diffusion", "vqvae"])
def test_a_resumed_run_is_the_same_run(make, tmp_path):
    """It is stopped at step 5 of 8, two steps after the last checkpoint, and resumed with new objects."""

    def task():
        return TASKS[make](optim=SHORT)

    whole, broken = Run(tmp_path / "a"), Run(tmp_path / "b")
    for run in (whole, broken):
        run.folder.mkdir()
    train(task(), SHORT, whole, 0, "whole")
    victim = task()
    step = victim.step

    def dying(number: int):
        if number == 5:
            raise Kill
        return step(number)

    victim.step = dying
    with pytest.raises(Kill):
        train(victim, SHORT, broken, 0, "broken")
    torch.rand(99)
    train(task(), SHORT, broken, 0, "again")
    expected, got = weights(whole), weights(broken)
    assert expected.keys() == got.keys()
    assert all(torch.equal(expected[name], got[name]) for name in expected)
    assert [m.values for m in whole.metrics()] == [m.values for m in broken.metrics()]


@pytest.mark.slow
@pytest.mark.parametrize("make", ["vqvae", "own", "upper_codes"])
def test_it_learns_and_logs(make, tmp_path):
    steps, run = 36 if make == "upper_codes" else 24, Run(tmp_path)
    changes = {"lr": 1e-2, "final_lr": 1e-3, "batch": 8, "checkpoint_every": 20, "validate_every": 12}
    optim = replace(OPTIM, steps=steps, **changes)
    train(TASKS[make](optim=optim), optim, run, 0, "learn")
    log = [entry for entry in run.metrics() if entry.phase == "train"]
    assert [entry.step for entry in log] == list(range(4, steps + 1, 4))
    error = next((name for name in ("rotation_all", "rotation") if name in log[0].values), "loss")
    assert log[-1].values[error] < 0.85 * log[0].values[error]
    assert [entry.step for entry in run.metrics() if entry.phase == "val"] == list(range(12, steps + 1, 12))


def test_a_loss_that_is_not_finite_stops_with_step_term_and_clips(tmp_path):
    task = motion_task("forced")
    frames = task.dataset.frames
    start, length = int(task.dataset.starts[1]), int(task.dataset.lengths[1])
    frames[start : start + length, 54 + 132 :] = float("nan")
    with pytest.raises(TrainingDiverged, match=r"step \d+, term .*position.*clip1") as stop:
        train(task, OPTIM, Run(tmp_path), 0, "diverge")
    assert "\n" not in str(stop.value)


def test_perplexity():
    assert compute_perplexity(torch.ones(8)) == pytest.approx(8)
    assert compute_perplexity(torch.tensor([5.0, 0, 0])) == pytest.approx(1)


ERRORS = {2: 9.0, 4: 5.0, 6: float("nan"), 8: 7.0}
BEST = replace(OPTIM, steps=8, validate_every=2, checkpoint_every=3, best_by="rotation")


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


def test_a_branch_that_is_not_validated_is_refused(tmp_path):
    with pytest.raises(InputError, match="best_by: 'position MPJPE' is not validated"):
        train(task_with_errors({}), replace(BEST, best_by="position"), Run(tmp_path), 0, "it")


def test_a_stopped_run_keeps_its_step_and_ends_in_the_same_weights(tmp_path, monkeypatch):
    """It is asked to stop during step 5 of 8, two steps after the last checkpoint."""
    monkeypatch.setattr(UsageTimer, "INTERVAL", 0.0)
    whole, stopped = Run(tmp_path / ("a" * 16)), Run(tmp_path / ("b" * 16))
    for run in (whole, stopped):
        run.folder.mkdir()
    train(TASKS["streams"](optim=SHORT), SHORT, whole, 0, "whole")
    task = TASKS["streams"](optim=SHORT)
    step = task.step

    def asked(number: int):
        if number == 4:
            stopped.request_stop()
        return step(number)

    task.step = asked
    with pytest.raises(RunStopped, match=f"memmlp runs retry {stopped.id}"):
        train(task, SHORT, stopped, 0, "stopped")
    assert checkpoint.read(stopped.checkpoint)[1]["step"] == 5
    used = [one.values for one in stopped.metrics() if one.phase == "system"]
    assert (len(used), all(0 < one["memory [GB]"] < 1000 for one in used)) == (5, True)
    stopped.retry()
    train(TASKS["streams"](optim=SHORT), SHORT, stopped, 0, "again")
    expected, got = weights(whole), weights(stopped)
    assert all(torch.equal(expected[name], got[name]) for name in expected)
