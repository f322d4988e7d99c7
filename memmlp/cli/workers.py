"""The workers of `memmlp sweep` and `memmlp tune`: their executor, number and GPUs."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import uuid4

import click

from memmlp.common.errors import InputError
from memmlp.common.overrides import Override

if TYPE_CHECKING:
    from memmlp.sweep.controller import Fleet
    from memmlp.sweep.executors.executor import Executor
    from memmlp.sweep.executors.gpus import Share
    from memmlp.sweep.plan import Plan

EXECUTORS = ("local", "slurm", "ray", "dask", "debug")  # the last one is for finding bugs
WITHOUT = {"cpu", "mps"}  # devices of runs that no GPU need be given to
SETTINGS = ("slurm", "ray", "dask")  # executors with words of their own
OWN = "executor"  # the words executor.KEY=VALUE are for one that is the path of a class


@dataclass(frozen=True)
class Workers:
    """The workers that a command line asks for.

    Attributes:
        executor: the executor's name.
        words: the executor's own settings, KEY -> VALUE of words like slurm.KEY=VALUE.
        count: how many run at once; None for a number that fits the machine.
        gpus_per_worker: GPUs of a worker on this machine; None for 1 if there are GPUs.
        workers_per_gpu: the largest number of workers that share a GPU of this machine; None for as many as
            are needed.
    """

    executor: str = "local"
    words: dict[str, str] = field(default_factory=dict)
    count: int | None = None
    gpus_per_worker: int | None = None
    workers_per_gpu: int | None = None

    def __post_init__(self) -> None:
        given = {"--gpus-per-worker": self.gpus_per_worker, "--workers-per-gpu": self.workers_per_gpu}
        for option in (
            name for name, value in given.items() if value is not None and self.executor != "local"
        ):
            raise InputError(f"{option}: goes with workers of this machine, and not executor={self.executor}")
        self.settings()

    def settings(self) -> Any:
        """Return the executor's own settings, checked. Raises InputError for a wrong one."""
        if self.executor == "slurm":
            from memmlp.sweep.executors.slurm import slurm_options

            return slurm_options(self.words)
        if self.executor == "ray":
            from memmlp.sweep.executors.ray_cluster import ray_options

            return ray_options(self.words)
        if self.executor == "dask":
            from memmlp.sweep.executors.dask_cluster import dask_options

            return dask_options(self.words)
        return None

    def script(self, folder: Path) -> str | None:
        """Return the file that sbatch would get; None for executors without one."""
        if self.executor != "slurm":
            return None
        from memmlp.sweep.executors.slurm import script

        return script(logs(folder), self.settings(), self.number())

    def number(self, shared: list[Share] | None = None) -> int:
        """Return how many workers run at once, given the shares of GPUs that they have on this machine."""
        from memmlp.sweep.executors.gpus import worker_count

        return worker_count(shared or [], self.count, self.workers_per_gpu)

    def shares(self, devices: Iterable[str]) -> list[Share]:
        """Return the shares of this machine's GPUs that local workers get for runs on these devices.

        Raises:
            InputError: if a run asks for a GPU that its worker can't have.
        """
        from memmlp.sweep.executors.gpus import shares, visible_gpus

        wanted = [name for name in devices if name not in WITHOUT]
        here = wanted and self.executor == "local" and self.gpus_per_worker != 0
        gpus = visible_gpus() if here else ()
        check_devices(wanted, gpus, self.executor)
        return shares(gpus, self.gpus_per_worker)


def check_devices(wanted: Iterable[str], gpus: Share, executor: str) -> None:
    """Check that workers can have the GPUs for which runs ask.

    Args:
        wanted: the values of the key `device` of runs that may use a GPU.
        gpus: the visible GPUs of this machine.
        executor: the executor's name.

    Raises:
        InputError: if they can't; the message names the key.
    """
    for name in wanted:
        if ":" in name:
            raise InputError(f"device={name}: allowed is auto, cuda, cpu or mps; each worker has its own GPU")
        if executor == "local" and name == "cuda" and not gpus:
            raise InputError("device=cuda: no GPU is visible here; allowed here is device=cpu or device=auto")
    if gpus and wanted:
        from memmlp.training.devices import missing_gpu

        if line := missing_gpu():
            raise InputError(line)


def logs(folder: Path) -> Path:
    """Return the path of the workers' logs for a sweep or search, with %j for a worker's number."""
    return folder / "workers" / "%j"


def worker_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options about workers to a command, which gets their values as `workers`.

    The command gets the remaining words as its overrides.
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
        executor, words, rest = split_executor(overrides)
        workers = Workers(executor, words, count, gpus_per_worker, workers_per_gpu)
        command(overrides=rest, workers=workers, **others)

    for option in reversed(options):
        wrapped = option(wrapped)
    return wrapped


def split_executor(words: Iterable[str]) -> tuple[str, dict[str, str], tuple[str, ...]]:
    """Split words into the executor's name, the executor's settings, and Hydra's overrides.

    Raises:
        InputError: for an unknown executor, or settings of another one.
    """
    executor, own, rest = "local", [], []
    for word in words:
        override = Override.parse(word)
        key, value = override.key, override.value or ""
        if key == "executor":
            executor = value
        elif key.split(".")[0] in (*SETTINGS, OWN) and "." in key:
            own.append((key, value))
        else:
            rest.append(word)
    if executor not in EXECUTORS and "." not in executor:
        raise InputError(f"executor={executor}: allowed is local, slurm, ray or dask, or the path of a class")
    for key, _ in own:
        group = key.split(".")[0]
        if group != (OWN if "." in executor else executor):
            goes = "a class of your own, executor=PATH" if group == OWN else f"executor={group}"
            raise InputError(f"{key}: goes with {goes}")
    return executor, {key.partition(".")[2]: value for key, value in own}, tuple(rest)


def executor(workers: Workers, folder: Path, shared: list[Share], gpus: bool) -> Executor:
    """Return the executor; its workers' logs are in `folder`/workers.

    Args:
        workers: what the command line asks for.
        folder: the folder of the sweep or search.
        shared: the shares of this machine's GPUs for local workers.
        gpus: whether runs may use a GPU.
    """
    if workers.executor == "slurm":
        from memmlp.sweep.executors.slurm import Slurm

        return Slurm(logs(folder), workers.settings())
    if workers.executor == "ray":
        from memmlp.sweep.executors.ray_cluster import Ray

        return Ray(workers.settings(), gpus)
    if workers.executor == "dask":
        from memmlp.sweep.executors.dask_cluster import Dask

        return Dask(workers.settings(), gpus)
    if "." in workers.executor:
        from memmlp.config.plugins import located

        return located(workers.executor, "executor")(logs(folder), workers.words)
    from memmlp.sweep.executors.local import Debug, Local

    return Debug(logs(folder)) if workers.executor == "debug" else Local(logs(folder), shared)


def hire(folder: Path, plan: Plan, workers: Workers, devices: Iterable[str]) -> tuple[Path, Fleet]:
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
    from memmlp.config.worker_process import work_alone, work_under_controller
    from memmlp.sweep.controller import Fleet
    from memmlp.sweep.worker import Presence

    named = set(devices)
    shared = workers.shares(named)
    count = workers.number(shared)
    made = executor(workers, folder, shared, gpus=not named <= WITHOUT)
    own = folder / "controllers" / uuid4().hex
    path = own.with_suffix(".json")
    plan.save(path)
    presence = Presence(own.with_suffix(".process"))
    gpu = made.gpus and not named <= WITHOUT
    if workers.executor == "local":
        threads = max((os.cpu_count() or 1) // count, 1)
        task = partial(work_under_controller, str(path), threads, str(presence.path), gpu)
    else:
        task = partial(work_alone, str(path), gpu)
    return path, Fleet(made, task, count, folder / "workers", presence)
