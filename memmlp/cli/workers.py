"""The workers of `memmlp sweep` and `memmlp tune`: their executor, number and GPUs."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import uuid4

import click

from memmlp.common.errors import InputError, import_optional
from memmlp.common.overrides import Override

if TYPE_CHECKING:
    from memmlp.sweep.controller import Fleet
    from memmlp.sweep.executors import Executor
    from memmlp.sweep.executors.local import Share
    from memmlp.sweep.plan import Plan

EXECUTORS = ("local", "slurm", "ray", "dask", "debug")  # the last one is for debuggers
WITHOUT_GPU = {"cpu", "mps"}  # devices of runs that need no GPU of CUDA
OWN_SETTINGS = ("slurm", "ray", "dask")  # executors with settings NAME.KEY=VALUE
CUSTOM = "executor"  # the settings executor.KEY=VALUE are those of an executor that is the path of a class


@dataclass(frozen=True)
class Workers:
    """The workers that a command line asks for.

    Attributes:
        executor: the executor's name, or the path of a class.
        settings: the executor's own settings, KEY -> VALUE of overrides like slurm.KEY=VALUE.
        count: how many run at once; None for a number that fits the machine.
        gpus_per_worker: GPUs of a worker on this machine; None for 1 if there are GPUs.
        workers_per_gpu: the largest number of workers that share a GPU of this machine; None for as many as
            are needed.
    """

    executor: str = "local"
    settings: dict[str, str] = field(default_factory=dict)
    count: int | None = None
    gpus_per_worker: int | None = None
    workers_per_gpu: int | None = None

    def __post_init__(self) -> None:
        given = {"--gpus-per-worker": self.gpus_per_worker, "--workers-per-gpu": self.workers_per_gpu}
        for option, value in given.items():
            if value is not None and self.executor != "local":
                raise InputError(
                    f"{option}: is for workers of this machine, not for executor={self.executor}"
                )
        self.options()

    def options(self) -> Any:
        """Return the executor's own settings, checked. Raises InputError for a wrong one."""
        if self.executor == "slurm":
            import_optional("submitit", "slurm", "executor=slurm")
            from memmlp.sweep.executors.slurm import slurm_options

            return slurm_options(self.settings)
        if self.executor not in ("ray", "dask"):
            return None
        from memmlp.sweep.executors import dask_cluster, parse_settings, ray_cluster

        module = ray_cluster if self.executor == "ray" else dask_cluster
        return parse_settings(self.executor, self.settings, module.SETTINGS)

    def script(self, folder: Path) -> str:
        """Return the file that sbatch would get; empty for executors without one."""
        if self.executor != "slurm":
            return ""
        from memmlp.sweep.executors.slurm import batch_script

        return batch_script(logs(folder), self.options(), self.number())

    def number(self, shares: Sequence[Share] = ()) -> int:
        """Return how many workers run at once, given the shares of GPUs that they have on this machine."""
        from memmlp.sweep.executors.local import worker_count

        return worker_count(shares, self.count, self.workers_per_gpu)

    def shares(self, devices: Iterable[str]) -> list[Share]:
        """Return the shares of this machine's GPUs that local workers get for runs on these devices.

        Args:
            devices: the values of the key `device` of the runs.

        Raises:
            InputError: if a run asks for a GPU that its worker can't have; the message names the key.
        """
        from memmlp.sweep.executors.local import divide_gpus, visible_gpus

        wanted = [name for name in devices if name not in WITHOUT_GPU]
        local = self.executor == "local"
        gpus = visible_gpus() if wanted and local and self.gpus_per_worker != 0 else ()
        for name in wanted:
            if ":" in name:
                raise InputError(
                    f"device={name}: expected auto, cuda, cpu or mps; each worker has its own GPU"
                )
            if local and name == "cuda" and not gpus:
                raise InputError("device=cuda: no GPU is visible here; use device=cpu or device=auto")
        if gpus:
            from memmlp.training.devices import describe_missing_gpu

            if line := describe_missing_gpu():
                raise InputError(line)
        return divide_gpus(gpus, self.gpus_per_worker)

    def start_executor(self, folder: Path, shares: Sequence[Share], gpus: bool) -> Executor:
        """Return the executor; its workers' logs are in `folder`/workers.

        Args:
            folder: the folder of the sweep or search.
            shares: the shares of this machine's GPUs for local workers.
            gpus: whether runs may use a GPU.
        """
        options = self.options()
        if self.executor == "slurm":
            from memmlp.sweep.executors.slurm import Slurm

            return Slurm(logs(folder), options)
        if self.executor == "ray":
            from memmlp.sweep.executors.ray_cluster import Ray

            return Ray(options, gpus)
        if self.executor == "dask":
            from memmlp.sweep.executors.dask_cluster import Dask

            return Dask(options, gpus)
        if "." in self.executor:
            from memmlp.config.plugins import import_object

            return import_object(self.executor, "executor")(logs(folder), self.settings)
        from memmlp.sweep.executors.local import Debug, Local

        return Debug() if self.executor == "debug" else Local(logs(folder), shares)


def logs(folder: Path) -> Path:
    """Return the path of the workers' logs for a sweep or search, with %j for a worker's number."""
    return folder / "workers" / "%j"


def worker_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options about workers to a command, which gets their values as `workers`.

    The command gets the remaining overrides as its `overrides`.
    """
    options = (
        click.option(
            "--workers",
            "count",
            type=click.IntRange(1),
            help="How many workers run at once.  [default: one a GPU, or without GPUs one a core]",
        ),
        click.option(
            "--gpus-per-worker",
            type=click.IntRange(0),
            help="GPUs of each worker of this machine, 0 for none.  [default: 1 where there are any]",
        ),
        click.option(
            "--workers-per-gpu", type=click.IntRange(1), help="Most workers that share a GPU of this machine."
        ),
    )

    @functools.wraps(command)
    def wrapped(
        overrides: tuple[str, ...],
        count: int | None,
        gpus_per_worker: int | None,
        workers_per_gpu: int | None,
        **others: Any,
    ) -> None:
        executor, settings, remaining = split_executor(overrides)
        workers = Workers(executor, settings, count, gpus_per_worker, workers_per_gpu)
        command(overrides=remaining, workers=workers, **others)

    for option in reversed(options):
        wrapped = option(wrapped)
    return wrapped


def split_executor(overrides: Iterable[str]) -> tuple[str, dict[str, str], tuple[str, ...]]:
    """Split overrides into the executor's name, the executor's settings, and Hydra's overrides.

    Raises:
        InputError: for an unknown executor, or settings of another one.
    """
    executor, own, remaining = "local", [], []
    for override in map(Override.parse, overrides):
        if override.key == "executor":
            executor = override.value or ""
        elif override.group in (*OWN_SETTINGS, CUSTOM):
            own.append(override)
        else:
            remaining.append(override.text)
    if executor not in EXECUTORS and "." not in executor:
        raise InputError(f"executor={executor}: expected local, slurm, ray, dask or the path of a class")
    for override in own:
        if override.group != (CUSTOM if "." in executor else executor):
            name = "PATH, a custom executor" if override.group == CUSTOM else override.group
            raise InputError(f"{override.key}: is for executor={name}")
    settings = {one.key.partition(".")[2]: one.value or "" for one in own}
    return executor, settings, tuple(remaining)


def start_fleet(folder: Path, plan: Plan, workers: Workers, devices: Iterable[str]) -> tuple[Path, Fleet]:
    """Save the plan in a file for this process alone, and return the file with a fleet of workers for it.

    No worker is started yet. Other processes that work on the same sweep have files of their own, so that
    none of them changes the plan of this one's workers.

    Args:
        folder: the folder of the sweep or search, which also holds the workers' logs.
        plan: the plan to work on.
        workers: what the command line asks for.
        devices: the values of the key `device` of the plan's runs.

    Raises:
        InputError: if workers can't have the GPUs that are asked for.
    """
    from memmlp.config.worker_process import work
    from memmlp.sweep.controller import Fleet
    from memmlp.sweep.worker import Presence

    named = set(devices)
    shares = workers.shares(named)
    count = workers.number(shares)
    may_use_gpu = not named <= WITHOUT_GPU
    executor = workers.start_executor(folder, shares, may_use_gpu)
    own = folder / "controllers" / uuid4().hex
    path = own.with_suffix(".json")
    plan.save(path)
    presence = Presence(own.with_suffix(".process"))
    gpu = executor.gpus and may_use_gpu
    local = workers.executor == "local"
    threads = max((os.cpu_count() or 1) // count, 1) if local else 0
    job = partial(work, str(path), threads, str(presence.path) if local else None, gpu)
    return path, Fleet(executor, job, count, folder / "workers", presence)
