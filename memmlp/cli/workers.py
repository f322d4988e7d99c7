"""The workers of `memmlp sweep` and `memmlp tune`: their executor, number and GPUs."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any
from uuid import uuid4

import click

from memmlp.common.errors import InputError
from memmlp.common.overrides import Override
from memmlp.common.processes import count_usable_cores
from memmlp.config.plugins import import_object
from memmlp.sweep.executors.slurm import Slurm, format_batch_script, parse_slurm_options
from memmlp.sweep.plan import Plan

if TYPE_CHECKING:
    from memmlp.sweep.controller import Fleet
    from memmlp.sweep.executors import Executor
    from memmlp.sweep.executors.local import GpuGroup

EXECUTORS = ("local", "slurm", "debug")  # debug runs everything in this process, for debuggers
DEVICES_WITHOUT_GPU = {"cpu", "mps"}  # devices that do not need a CUDA GPU
SETTINGS = ("slurm", "executor")
"""Prefixes of settings: slurm.KEY=VALUE, and executor.KEY=VALUE for a custom executor."""


@dataclass(frozen=True)
class Workers:
    """The workers that a command line requests: the executor's name, or the path of a class, its settings
    (slurm.KEY=VALUE), number of concurrent workers, GPUs per worker and maximum of workers per GPU on this
    machine. None is this machine's default (1 GPU if available; no limit)."""

    executor: str = "local"
    settings: dict[str, str] = field(default_factory=dict)
    count: int | None = None
    gpus_per_worker: int | None = None
    workers_per_gpu: int | None = None

    def __post_init__(self) -> None:
        given = {"--gpus-per-worker": self.gpus_per_worker, "--workers-per-gpu": self.workers_per_gpu}
        for option, value in given.items():
            if value is not None and self.executor != "local":
                raise InputError(f"{option}: needs workers of this machine, executor=local")
        if self.executor == "slurm":
            parse_slurm_options(self.settings)  # raises InputError for a wrong setting

    def make_batch_script(self, folder: Path) -> str:
        """Return the batch file for sbatch; an empty text for executors other than Slurm."""
        if self.executor != "slurm":
            return ""
        options = parse_slurm_options(self.settings)
        return format_batch_script(get_log_path(folder), options, self.count_workers())

    def count_workers(self, shares: Sequence[GpuGroup] = ()) -> int:
        from memmlp.sweep.executors.local import count_workers

        return count_workers(shares, self.count, self.workers_per_gpu)

    def make_gpu_shares(self, devices: Iterable[str]) -> list[GpuGroup]:
        """Divide this machine's GPUs into shares for local workers. Raises InputError without a usable
        GPU."""
        from memmlp.sweep.executors.local import divide_gpus, list_visible_gpus

        gpu_devices = [name for name in devices if name not in DEVICES_WITHOUT_GPU]
        local = self.executor == "local"
        gpus = list_visible_gpus() if gpu_devices and local and self.gpus_per_worker != 0 else ()
        for name in gpu_devices:
            if ":" in name:
                raise InputError(f"device={name}: must be auto, cuda, cpu or mps; a worker has its own GPU")
            if local and name == "cuda" and not gpus:
                raise InputError("device=cuda: no GPU is visible here; use device=cpu or device=auto")
        if gpus:
            from memmlp.training.devices import describe_missing_gpu

            if line := describe_missing_gpu():
                raise InputError(line)
        return divide_gpus(gpus, self.gpus_per_worker)

    def start_executor(self, folder: Path, shares: Sequence[GpuGroup]) -> Executor:
        if self.executor == "slurm":
            return Slurm(get_log_path(folder), parse_slurm_options(self.settings))
        if "." in self.executor:
            return import_object(self.executor, "executor")(get_log_path(folder), self.settings)
        from memmlp.sweep.executors.local import DebugExecutor, LocalExecutor

        return DebugExecutor() if self.executor == "debug" else LocalExecutor(get_log_path(folder), shares)


def get_log_path(folder: Path) -> Path:
    """Return the path of the workers' logs for a sweep or search; %j stands for a worker's number."""
    return folder / "workers" / "%j"


def add_worker_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the worker options to a command, which gets `workers`, and `overrides` without the executor's."""
    options = (
        click.option(
            "--workers",
            "count",
            type=click.IntRange(1),
            help="Number of concurrent workers. Local ones divide the cores: with 2 on 2 cores, each has one "
            "thread.  [default: one per GPU, or one per core without GPUs]",
        ),
        click.option(
            "--gpus-per-worker",
            type=click.IntRange(0),
            help="Number of GPUs per worker on this machine.  [default: 1 if available, otherwise 0]",
        ),
        click.option(
            "--workers-per-gpu",
            type=click.IntRange(1),
            help="Maximum number of workers that share a GPU of this machine.",
        ),
    )

    @functools.wraps(command)
    def call_with_workers(
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
        call_with_workers = option(call_with_workers)
    return call_with_workers


def split_executor(overrides: Iterable[str]) -> tuple[str, dict[str, str], tuple[str, ...]]:
    """Split overrides into the executor's name, its settings, and the remaining overrides."""
    executor, executor_settings, remaining = "local", [], []
    for override in map(Override.parse, overrides):
        if override.key == "executor":
            executor = override.value or ""
        elif override.group in SETTINGS:
            executor_settings.append(override)
        else:
            remaining.append(override.text)
    if executor not in EXECUTORS and "." not in executor:
        raise InputError(f"executor={executor}: expected local, slurm or the path of a class")
    for override in executor_settings:
        if override.group != ("executor" if "." in executor else executor):
            name = "PATH, a custom executor" if override.group == "executor" else override.group
            raise InputError(f"{override.key}: needs executor={name}")
    settings = {one.key.partition(".")[2]: one.value or "" for one in executor_settings}
    return executor, settings, tuple(remaining)


def start_fleet(folder: Path, plan: Plan, workers: Workers, devices: Iterable[str]) -> tuple[Path, Fleet]:
    """Save the plan in a new file, and return the file and a fleet of workers for it, none of which is
    started. Each controller has a separate file, so it cannot change the plan of another one's workers."""
    from memmlp.config.worker_process import work
    from memmlp.sweep.controller import Fleet
    from memmlp.sweep.worker import write_process_file

    named = set(devices)
    shares = workers.make_gpu_shares(named)
    count = workers.count_workers(shares)
    may_use_gpu = not named <= DEVICES_WITHOUT_GPU
    executor = workers.start_executor(folder, shares)
    stem = folder / "controllers" / uuid4().hex
    path = stem.with_suffix(".json")
    plan.save(path)
    write_process_file(process := stem.with_suffix(".process"))
    gpu = executor.gpus and may_use_gpu
    local = workers.executor == "local"
    threads = max(count_usable_cores() // count, 1) if local else 0
    job = partial(work, str(path), threads, str(process) if local else None, gpu)
    return path, Fleet(executor, job, count, folder / "workers")
