"""Workers that are jobs of a Slurm cluster, submitted with submitit as job arrays."""

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
from memmlp.common.text_formats import print_in_any_encoding
from memmlp.sweep.executors import Work

TIME = re.compile(r"(?:(?P<days>\d+)-)?(?P<first>\d+)(?::(?P<second>\d+))?(?::(?P<third>\d+))?")
RESERVED = ("array", "output", "error", "open_mode", "signal", "wrap", "wait", "parsable", "test_only")
FIXED_TO_ONE = ("nodes", "ntasks", "ntasks_per_node", "ntasks_per_gpu")  # since a worker is one task


@dataclass(frozen=True)
class SlurmOptions:
    """The options of submitted jobs.

    Attributes:
        parameters: sbatch's options by long name, with _ in place of -; True for an option without a value.
        srun: arguments for srun, which starts the worker inside the job.
        setup: a shell command that each job runs first, or None.
        python: the command that starts Python in the job; None for the Python of this process.
        minutes: the time limit in minutes.
    """

    parameters: Mapping[str, str | bool] = field(default_factory=dict)
    srun: tuple[str, ...] = ()
    setup: str | None = None
    python: str | None = None
    minutes: int = 60

    @property
    def gpu(self) -> bool:
        """Whether a job requests GPUs."""
        resources = [value for key, value in self.parameters.items() if key in ("gres", "tres_per_task")]
        counted = any(key.startswith("gpus") for key in self.parameters)
        return counted or any("gpu" in str(value) for value in resources)


def parse_slurm_options(settings: Mapping[str, str]) -> SlurmOptions:
    """Return the options for settings `slurm.KEY=VALUE`.

    Raises:
        InputError: for an invalid value, and for an option that memmlp sets itself.
    """
    values = {key.replace("-", "_"): value for key, value in settings.items()}
    setup, python = values.pop("setup", None), values.pop("python", None)
    srun = shlex.split(values.pop("srun", ""))
    containers = sorted(key for key in values if key.startswith("container"))
    srun += [f"--{key.replace('_', '-')}={values.pop(key)}" for key in containers]
    parameters: dict[str, str | bool] = {}
    for key, value in values.items():
        parameters |= _parse_parameter(key, value)
    if "time" not in values:
        raise InputError("slurm.time: has no value; set the time limit of a job with slurm.time=H:MM:SS")
    return SlurmOptions(parameters, tuple(srun), setup, python, _parse_minutes(values["time"]))


def _parse_parameter(key: str, value: str) -> dict[str, str | bool]:
    if key in RESERVED:
        raise InputError(f"slurm.{key}: is set by memmlp; expected another sbatch option")
    if key in FIXED_TO_ONE:
        raise InputError(
            f"slurm.{key}: cannot be set, because a worker is one task on one node; use --workers N"
        )
    if not re.fullmatch(r"[a-z][a-z0-9_]*", key) or not value or not value.isprintable():
        raise InputError(f"slurm.{key}={value}: expected the long name of an sbatch option, and a value")
    if key == "mem_gb":
        return {"mem": f"{_parse_number(key, value)}GB"}
    if key == "cpus":
        return {"cpus_per_task": str(_parse_number(key, value))}
    if key == "gpus":
        return {"gpus_per_node": value if ":" in value else str(_parse_number(key, value))}
    return {} if value == "false" else {key: value == "true" or value}


def _parse_number(key: str, value: str) -> int:
    if not value.isdecimal() or int(value) == 0:
        raise InputError(f"slurm.{key}={value}: must be a whole number above 0")
    return int(value)


def _parse_minutes(text: str) -> int:
    """Return the minutes, rounded up, of a Slurm time M, M:S, H:M:S, D-H, D-H:M or D-H:M:S."""
    match = TIME.fullmatch(text)
    if not match:
        raise InputError(f"slurm.time={text}: expected MINUTES, H:MM:SS, D-HH or D-HH:MM")
    days, *parts = (int(part) if part else 0 for part in match.group("days", "first", "second", "third"))
    if not match["days"] and not match["third"]:
        parts = [0, *parts[:2]]  # without hours
    hours, minutes, seconds = parts
    return (days * 24 + hours) * 60 + minutes + (seconds > 0)


class RequeuedWork:
    """Work that is queued again if its job is preempted. Runs continue from their checkpoints."""

    def __init__(self, work: Work):
        self.work = work

    def __call__(self) -> str | None:
        """Do the work. submitit calls this in the job's process."""
        collect_garbage_rarely()
        print_in_any_encoding()
        return self.work()

    def checkpoint(self) -> Any:
        """Return a new submission of the work. submitit queues it when the job is preempted or times out."""
        return submitit.helpers.DelayedSubmission(self)


class SubmititSlurm(submitit.SlurmExecutor):
    """Submitit's executor with memmlp's options."""

    def set_options(self, options: SlurmOptions) -> None:
        """Set the options of later submissions."""
        given = {"additional_parameters": dict(options.parameters), "srun_args": list(options.srun)}
        setup = {"setup": [options.setup]} if options.setup else {}
        # submitit's default wckey is rejected by clusters without wckeys.
        self.update_parameters(job_name="memmlp", time=options.minutes, wckey=None, **given, **setup)


class UnsentSlurm(SubmititSlurm):
    """An executor that only makes the submission file, also on machines without Slurm."""

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
        """Return the line that explains why the worker could not work; None after any other end."""
        if not self.job.paths.result_pickle.exists() or self.job.exception() is not None:
            return None
        return self.job.result()


class Slurm:
    """Starts workers as jobs of the Slurm cluster of this machine.

    Args:
        folder: the folder of the workers' logs, with %j in place of a job's number.
        options: the options of the jobs.

    Raises:
        InputError: if Slurm is not installed, or could not use the folder.
    """

    def __init__(self, folder: Path, options: SlurmOptions):
        _check_folder(folder)
        with _convert_errors():
            self.executor = SubmititSlurm(folder=folder, python=options.python)
            self.executor.set_options(options)
        self.imports = pass_import_paths_to_children if options.python is None else contextlib.nullcontext
        self.gpus = options.gpu

    def submit(self, work: Work, count: int = 1) -> list[Job]:
        """Start workers as a job array. Raises InputError if sbatch rejects an option."""
        with _convert_errors():
            with self.imports(), self.executor.batch():
                jobs: list[Any] = [self.executor.submit(RequeuedWork(work)) for _ in range(count)]
            return [Job(job) for job in jobs]


def format_batch_script(folder: Path, options: SlurmOptions, workers: int) -> str:
    """Return the text of the sbatch script for this number of workers, also on machines without Slurm."""
    _check_folder(folder)
    executor = UnsentSlurm(folder=folder, python=options.python)
    executor.set_options(options)
    if workers > 1:
        executor.parameters["map_count"] = workers
    return executor._make_submission_file_text(executor._submitit_command_str, "worker")


def _check_folder(folder: Path) -> None:
    """Raise InputError for a folder with characters that Slurm or submitit would replace in log paths."""
    path = folder.absolute().parent
    if not str(path).isprintable() or set(str(path)) & {*"%\\"}:
        raise InputError(f"executor=slurm: {path}: must not contain % or \\ or control characters; rename it")


@contextlib.contextmanager
def _convert_errors() -> Iterator[None]:
    logging.getLogger("submitit").setLevel(logging.ERROR)
    try:
        yield
    except (RuntimeError, TypeError, ValueError, NameError) as error:
        raise InputError(f"executor=slurm: {' '.join(str(error).split())}") from None
