"""What a worker of a sweep does with a task: build its experiment and bring its run to its end."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from memmlp.sweep.plan import Plan, Task
from memmlp.sweep.worker import Cancelled, Presence
from memmlp.sweep.worker import work as work_on


def work(path: str, threads: int, controller: str) -> None:
    """Take tasks of the plan in that file while its controller's process lives."""
    work_on(Path(path), partial(perform, Path(path), threads), lambda: Presence.of(Path(controller)))


def work_alone(path: str) -> None:
    """Take tasks of the plan in that file until none is left, whether or not the controller stays."""
    work_on(Path(path), partial(perform, Path(path), 0))


def perform(path: Path, threads: int, plan: Plan, task: Task) -> None:
    """Bring the task's run to its end; Cancelled if the plan no longer wants it.

    threads: of torch, where the config leaves them open; 0 for torch's choice.
    """
    import torch
    from omegaconf import OmegaConf

    from memmlp import pipeline
    from memmlp.cli.build import build_experiment

    experiment = build_experiment(OmegaConf.create(dict(task.config)))
    if chosen := experiment.config["threads"] or threads:
        torch.set_num_threads(chosen)
    if task.kind == "vqvae":
        pipeline.vqvae_run(experiment, *experiment.data.prepare())
    else:
        pipeline.run(experiment, partial(check_wanted, path, task.id))


def check_wanted(path: Path, run_id: str, step: int, values: dict[str, float]) -> None:
    """Raise Cancelled once the plan in that file has given the run up."""
    if run_id in Plan.load(path).cancelled:
        raise Cancelled(f"run {run_id} was cancelled at step {step}")
