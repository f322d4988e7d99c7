"""What a worker of a sweep does with a task: it builds the experiment and finishes its run.

This is in config because only config builds experiments from configs.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from memmlp.common.errors import InputError
from memmlp.sweep.plan import Plan, RunTask
from memmlp.sweep.worker import Cancelled, Presence, has_controller, work_off
from memmlp.training.request import RunRequest


def work(path: str, threads: int, controller: str | None, gpu: bool) -> str | None:
    """Work on the tasks of the plan in a file.

    Args:
        path: the plan's file.
        threads: torch's threads if the config leaves them open; 0 leaves the choice to torch.
        controller: the file that identifies the controller's process (`Presence`), with which the worker
            ends. None for a worker on another machine: it works on a closed plan (a sweep's) to its end, and
            on an open one (a search's) while its controller shows signs of life.
        gpu: whether this worker should have a GPU.

    Returns:
        A line if there is no such GPU and nothing was done; else None.
    """
    if gpu and (line := describe_missing_gpu()):
        return line
    wanted = partial(Presence.of, Path(controller)) if controller else partial(has_controller, Path(path))
    work_off(Path(path), partial(perform, Path(path), threads), wanted)
    return None


def describe_missing_gpu() -> str | None:
    """Return a line that says that torch finds no GPU in a worker that should have one; None if it does."""
    from memmlp.training import devices  # it imports torch

    return devices.describe_missing_gpu()


def perform(path: Path, threads: int, plan: Plan, task: RunTask) -> None:
    """Finish the task's run.

    Args:
        path: the plan's file, read again during the training, to see whether the run is still wanted.
        threads: torch's threads if the config leaves them open; 0 leaves the choice to torch.

    Raises:
        Cancelled: if the plan no longer wants the run.
        InputError: if data or code changed since the plan was made.
    """
    from omegaconf import OmegaConf

    from memmlp.config.build import build_experiment
    from memmlp.config.plugins import activate
    from memmlp.runs.identity import NETWORK
    from memmlp.training.devices import use_threads
    from memmlp.training.run_stages import make_prerequisites, run_experiment

    activate(task.config.get("plugins") or ())
    experiment = build_experiment(OmegaConf.create(dict(task.config)))
    check_identity(experiment, task)
    use_threads(experiment.config["threads"] or threads)
    if task.kind != NETWORK:
        make_prerequisites(experiment, experiment.motion.prepare(), task.id)
    else:
        run_experiment(experiment, partial(check_wanted, path, task.id))


def check_identity(request: RunRequest, task: RunTask) -> None:
    """Prepare the data, and raise InputError if the task's identity is no longer the plan's."""
    from memmlp.config.compose_plan import tasks_of

    known = tasks_of(request, request.motion.prepare().digest)
    if task.key not in {key for found in known for key in (found.id, found.key)}:
        raise InputError(f"run {task.id}: the data or the code changed since the sweep began; start it again")


def check_wanted(path: Path, run_id: str, step: int, values: dict[str, float]) -> None:
    """Raise Cancelled once the plan in a file no longer wants this run."""
    plan = Plan.load(path)
    if run_id in plan.cancelled:
        raise Cancelled(f"run {run_id} was cancelled at step {step}")
