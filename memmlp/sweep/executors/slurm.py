"""Workers that are jobs of a Slurm cluster, submitted by submitit; an array of those that start together."""

from __future__ import annotations

import contextlib
import logging
import re
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import submitit
import submitit.helpers

from memmlp.common.errors import InputError
from memmlp.common.processes import collect_garbage_rarely, pass_import_paths_to_children
from memmlp.sweep.executors import Work

TIME = re.compile(r"(?:(?P<days>\d+)-)?(?P<first>\d+)(?::(?P<second>\d+))?(?::(?P<third>\d+))?")
OURS = ("array", "output", "error", "open_mode", "signal", "wrap", "wait", "parsable", "test_only")
ONE = ("nodes", "ntasks", "ntasks_per_node", "ntasks_per_gpu")  # a worker is one task


@dataclass(frozen=True)
class SlurmOptions:
    """The options with which jobs are submitted.

    Attributes:
        parameters: sbatch's parameters by their long names, with _ for -; True for one without a value.
        srun: arguments for srun, which starts the worker inside the job.
        setup: a shell command that each job runs first; None for none.
        python: the command that starts Python in the job; None for this process' own.
        minutes: the time limit.
    """

    parameters: Mapping[str, str | bool] = field(default_factory=dict)
    srun: tuple[str, ...] = ()
    setup: str | None = None
    python: str | None = None
    minutes: int = 60

    @property
    def gpu(self) -> bool:
        """Whether a job asks for GPUs."""
        wanted = [value for key, value in self.parameters.items() if key in ("gres", "tres_per_task")]
        counted = any(key.startswith("gpus") for key in self.parameters)
        return counted or any("gpu" in str(value) for value in wanted)


def slurm_options(settings: Mapping[str, str]) -> SlurmOptions:
    """Return the options that `slurm.KEY=VALUE` on a command line set.

    Raises:
        InputError: for a value of the wrong kind, and for options that memmlp sets itself.
    """
    known = {key.replace("-", "_"): value for key, value in settings.items()}
    setup, python = known.pop("setup", None), known.pop("python", None)
    srun = shlex.split(known.pop("srun", ""))
    containers = sorted(key for key in known if key.startswith("container"))
    srun += [f"--{key.replace('_', '-')}={known.pop(key)}" for key in containers]
    parameters: dict[str, str | bool] = {}
    for key, value in known.items():
        parameters |= _parameter(key, value)
    if "time" not in known:
        raise InputError("slurm.time: has no value; give the time limit of a job with slurm.time=H:MM:SS")
    return SlurmOptions(parameters, tuple(srun), setup, python, _minutes(known["time"]))


def _parameter(key: str, value: str) -> dict[str, str | bool]:
    if key in OURS:
        raise InputError(f"slurm.{key}: is set by memmlp; expected another option of sbatch")
    if key in ONE:
        raise InputError(f"slurm.{key}: cannot be set, since a worker is one task on one node (--workers)")
    if not re.fullmatch(r"[a-z][a-z0-9_]*", key) or not value or not value.isprintable():
        raise InputError(f"slurm.{key}={value}: expected the long name of an option of sbatch, and a value")
    if key == "mem_gb":
        return {"mem": f"{_number(key, value)}GB"}
    if key == "cpus":
        return {"cpus_per_task": str(_number(key, value))}
    if key == "gpus":
        return {"gpus_per_node": value if ":" in value else str(_number(key, value))}
    return {} if value == "false" else {key: value == "true" or value}


def _number(key: str, value: str) -> int:
    if not value.isdecimal() or int(value) == 0:
        raise InputError(f"slurm.{key}={value}: must be a whole number above 0")
    return int(value)


def _minutes(text: str) -> int:
    """Return a time in minutes, rounded up, from Slurm's forms M, M:S, H:M:S, D-H, D-H:M or D-H:M:S."""
    found = TIME.fullmatch(text)
    if not found:
        raise InputError(f"slurm.time={text}: expected MINUTES, H:MM:SS, D-HH or D-HH:MM")
    days, *parts = (int(part) if part else 0 for part in found.group("days", "first", "second", "third"))
    if not found["days"] and not found["third"]:
        parts = [0, *parts[:2]]  # without hours
    hours, minutes, seconds = parts
    return (days * 24 + hours) * 60 + minutes + (seconds > 0)


class Requeued:
    """Work that a preempted job does again; its runs continue from their checkpoints."""

    def __init__(self, work: Work):
        self.work = work

    def __call__(self) -> str | None:
        """Do the work, in the process that submitit started for it."""
        collect_garbage_rarely()
        return self.work()

    def checkpoint(self) -> Any:
        """Return the submission that submitit queues when the job is preempted or its time is up."""
        return submitit.helpers.DelayedSubmission(self)


class SubmititSlurm(submitit.SlurmExecutor):
    """Submitit's executor with memmlp's options."""

    def set(self, options: SlurmOptions) -> None:
        """Set the options with which jobs are submitted."""
        given = {"additional_parameters": dict(options.parameters), "srun_args": list(options.srun)}
        setup = {"setup": [options.setup]} if options.setup else {}
        # Submitit would set a wckey of its own, which clusters without such keys refuse.
        self.update_parameters(job_name="memmlp", time=options.minutes, wckey=None, **given, **setup)


class Unsent(SubmititSlurm):
    """An executor that only writes the submission file; Slurm need not be installed."""

    @classmethod
    def affinity(cls) -> int:
        """Return 1, which tells submitit that Slurm is available."""
        return 1


class Job:
    """A worker that is a job of Slurm."""

    def __init__(self, job: submitit.Job):
        self.job = job

    def alive(self) -> bool:
        """Return whether the job is waiting or working."""
        return not self.job.done()

    def cancel(self) -> None:
        """End the job."""
        self.job.cancel(check=False)

    def complaint(self) -> str | None:
        """Return the worker's own line about why it could do no work; None after any other end."""
        if not self.job.paths.result_pickle.exists() or self.job.exception() is not None:
            return None
        return self.job.result()


class Slurm:
    """Starts workers as jobs of the Slurm cluster of this machine.

    Args:
        folder: the folder of the workers' logs, with %j for a job's number.
        options: the options with which jobs are submitted.

    Raises:
        InputError: if Slurm is not installed.
    """

    def __init__(self, folder: Path, options: SlurmOptions):
        with _one_line_errors():
            self.executor = SubmititSlurm(folder=folder, python=options.python)
            self.executor.set(options)
        self.imports = pass_import_paths_to_children if options.python is None else contextlib.nullcontext
        self.gpus = options.gpu

    def submit(self, work: Work, count: int = 1) -> list[Job]:
        """Start workers as one job array. Raises InputError if sbatch refuses an option."""
        with _one_line_errors():
            with self.imports(), self.executor.batch():
                jobs: list[Any] = [self.executor.submit(Requeued(work)) for _ in range(count)]
            return [Job(job) for job in jobs]


def batch_script(folder: Path, options: SlurmOptions, workers: int) -> str:
    """Return the file that sbatch would get for the given number of workers; Slurm need not be installed."""
    executor = Unsent(folder=folder, python=options.python)
    executor.set(options)
    if workers > 1:
        executor.parameters["map_count"] = workers
    return executor._make_submission_file_text(executor._submitit_command_str, "worker")


@contextlib.contextmanager
def _one_line_errors() -> Iterator[None]:
    logging.getLogger("submitit").setLevel(logging.ERROR)
    try:
        yield
    except (RuntimeError, TypeError, ValueError, NameError) as error:
        raise InputError(f"executor=slurm: {' '.join(str(error).split())}") from None
