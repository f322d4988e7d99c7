"""What a worker of a sweep does with a task: it builds the experiment and brings its run to its end.

It lies in config because only config builds experiments from configs.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from memmlp.common.errors import InputError
from memmlp.sweep.plan import Plan, RunTask
from memmlp.sweep.worker import Cancelled, Presence, directed, work_off

if TYPE_CHECKING:
    from memmlp.pipeline.experiment import Experiment


def start_worker(path: str, threads: int, controller: str, gpu: bool) -> str | None:
    """Work on the tasks of the plan in that file for as long as the process of its controller lives.

    Args:
        path: the plan's file.
        threads: torch's threads where the config leaves them open; 0 leaves the choice to torch.
        controller: the file that says which process the controller is (`Presence`).
        gpu: whether this worker is to have a GPU.

    Returns:
        A line, and nothing was done, where there is no such GPU; else None.
    """
    if gpu and (line := missing_gpu()):
        return line
    work_off(Path(path), partial(perform, Path(path), threads), lambda: Presence.of(Path(controller)))
    return None


def start_lone_worker(path: str, gpu: bool) -> str | None:
    """Work on the tasks of the plan in that file until none is left, on a machine apart from the controller.

    A worker on a cluster outlives the process that started it: a closed plan (a sweep's) is worked to its
    end, an open one (a search's) while its controller still shows signs of life.

    Args:
        path: the plan's file.
        gpu: whether this worker is to have a GPU.

    Returns:
        A line, and nothing was done, where there is no such GPU; else None.
    """
    if gpu and (line := missing_gpu()):
        return line
    work_off(Path(path), partial(perform, Path(path), 0), lambda: directed(Path(path)))
    return None


def missing_gpu() -> str | None:
    """Return a line that says so where torch finds no GPU in a worker that is to have one."""
    from memmlp.pipeline import devices  # it imports torch

    return devices.missing_gpu()


def perform(path: Path, threads: int, plan: Plan, task: RunTask) -> None:
    """Bring the task's run to its end.

    Args:
        path: the plan's file, read again on the way to see whether the run is still wanted.
        threads: torch's threads where the config leaves them open; 0 leaves the choice to torch.

    Raises:
        Cancelled: when the plan no longer wants the run.
        InputError: when data or code changed since the plan was made.
    """
    import torch
    from omegaconf import OmegaConf

    from memmlp.config.build import build_experiment
    from memmlp.config.plugins import activate
    from memmlp.pipeline.run_stages import run_experiment, upstream_run
    from memmlp.runs.identity import NETWORK

    activate(task.config.get("plugins") or ())
    experiment = build_experiment(OmegaConf.create(dict(task.config)))
    check_identity(experiment, task)
    if chosen := experiment.config["threads"] or threads:
        torch.set_num_threads(chosen)
    if task.kind != NETWORK:
        upstream_run(experiment, experiment.data.prepare(), task.id)
    else:
        run_experiment(experiment, partial(check_wanted, path, task.id))


def check_identity(experiment: Experiment, task: RunTask) -> None:
    """Raise InputError where this code and data give the task's config another identity than the plan has."""
    from memmlp.config.plan_sweep import tasks_of

    digest = experiment.data.prepare().digest
    known = tasks_of(experiment, digest)
    if task.key not in {key for found in known for key in (found.id, found.key)}:
        raise InputError(f"run {task.id}: the data or the code changed since the sweep began; start it again")


def check_wanted(path: Path, run_id: str, step: int, values: dict[str, float]) -> None:
    """Raise Cancelled once the plan in that file no longer wants this run, or was stopped as a whole."""
    plan = Plan.load(path)
    if run_id in plan.cancelled or plan.stopped:
        raise Cancelled(f"run {run_id} was cancelled at step {step}")
