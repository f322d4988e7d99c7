"""Workers that are jobs of a Slurm cluster, all that start at once being one array."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import submitit
import submitit.helpers

from memmlp.common.errors import InputError
from memmlp.sweep.executors.executor import Work
from memmlp.sweep.executors.submitit_jobs import UNLIMITED, Requeued, Submitted, explained

TIME = re.compile(r"(?:(?P<days>\d+)-)?(?P<first>\d+)(?::(?P<second>\d+))?(?::(?P<third>\d+))?")
OURS = ("array", "output", "error", "open_mode", "signal", "wrap", "wait", "parsable", "test_only")
ONE = ("nodes", "ntasks", "ntasks_per_node", "ntasks_per_gpu")  # a worker is one task


@dataclass(frozen=True)
class SlurmOptions:
    """What the jobs are asked for with.

    Attributes:
        parameters: sbatch's parameters by their long names, with _ for -; True for one without a value.
        srun: words for srun, which starts the worker inside the job.
        setup: a shell command that each job runs first; None for none.
        python: the command that starts Python in the job; None for this process' own.
        minutes: the time limit, if `parameters` has one that is a number of them.
    """

    parameters: Mapping[str, str | bool] = field(default_factory=dict)
    srun: tuple[str, ...] = ()
    setup: str | None = None
    python: str | None = None
    minutes: int | None = None

    @property
    def gpu(self) -> bool:
        """Whether a job asks for GPUs."""
        wanted = [value for key, value in self.parameters.items() if key in ("gres", "tres_per_task")]
        counted = any(key.startswith("gpus") for key in self.parameters)
        return counted or any("gpu" in str(value) for value in wanted)


def slurm_options(words: Mapping[str, str]) -> SlurmOptions:
    """Return the options that the words `slurm.KEY=VALUE` of a command line ask for.

    Raises:
        InputError: for a value of the wrong kind, and for what memmlp itself has to set.
    """
    known = {key.replace("-", "_"): value for key, value in words.items()}
    setup, python = known.pop("setup", None), known.pop("python", None)
    srun = shlex.split(known.pop("srun", ""))
    srun += [f"--{_dashed(key)}={known.pop(key)}" for key in sorted(known) if key.startswith("container")]
    parameters: dict[str, str | bool] = {}
    for key, value in known.items():
        parameters |= _parameter(key, value)
    limit = _minutes(known["time"]) if "time" in known else None
    return SlurmOptions(parameters, tuple(srun), setup, python, limit)


def _parameter(key: str, value: str) -> dict[str, str | bool]:
    """Return a word as a parameter of sbatch's."""
    if key in OURS:
        raise InputError(f"slurm.{key}: is set by memmlp; allowed are sbatch's other options")
    if key in ONE:
        raise InputError(f"slurm.{key}: allowed is none, since a worker is one task on one node (--workers)")
    if not re.fullmatch(r"[a-z][a-z0-9_]*", key) or not value or not value.isprintable():
        raise InputError(f"slurm.{key}={value}: allowed is the long name of an option of sbatch, and a value")
    if key == "mem_gb":
        return {"mem": f"{_number(key, value)}GB"}
    if key == "cpus":
        return {"cpus_per_task": str(_number(key, value))}
    if key == "gpus":
        return {"gpus_per_node": value if ":" in value else str(_number(key, value))}
    return {} if value == "false" else {key: value == "true" or value}


def _number(key: str, value: str) -> int:
    if not value.isdecimal() or int(value) == 0:
        raise InputError(f"slurm.{key}={value}: allowed is a whole number above 0")
    return int(value)


def _minutes(text: str) -> int:
    """Return the minutes, rounded up, of a time as Slurm writes it: M, M:S, H:M:S, D-H, D-H:M or D-H:M:S."""
    found = TIME.fullmatch(text)
    if not found:
        raise InputError(f"slurm.time={text}: allowed are MINUTES, H:MM:SS, D-HH and D-HH:MM")
    days, *parts = (int(part) if part else 0 for part in found.group("days", "first", "second", "third"))
    if not found["days"] and not found["third"]:
        parts = [0, *parts[:2]]  # without hours
    hours, minutes, seconds = parts
    return (days * 24 + hours) * 60 + minutes + (seconds > 0)


def _dashed(key: str) -> str:
    return key.replace("_", "-")


class DelayedSubmission(submitit.helpers.DelayedSubmission):  # submitit looks for this name
    """Work on its way to a job that may have no time limit."""

    def set_timeout(self, timeout_min: int | None, max_num_timeout: int) -> None:
        """Keep the time limit in minutes, by which submitit tells the end of the time from a preemption."""
        super().set_timeout(timeout_min or UNLIMITED, max_num_timeout)


class SlurmExecutor(submitit.SlurmExecutor):
    """Submitit's executor, which starts jobs without a time limit, too: the cluster's own holds then."""

    def _internal_process_submissions(self, delayed_submissions: list) -> list:
        given: list = [
            DelayedSubmission(one.function, *one.args, **one.kwargs) for one in delayed_submissions
        ]
        return super()._internal_process_submissions(given)

    def set(self, options: SlurmOptions) -> None:
        """Ask for jobs with these options."""
        words = {"additional_parameters": dict(options.parameters), "srun_args": list(options.srun)}
        setup = {"setup": [options.setup]} if options.setup else {}
        # Submitit would set a wckey of its own, which clusters without such keys refuse.
        self.update_parameters(job_name="memmlp", time=options.minutes, wckey=None, **words, **setup)


class Unsent(SlurmExecutor):
    """An executor that only writes the file, for which Slurm need not be installed."""

    @classmethod
    def affinity(cls) -> int:
        """Return that Slurm is there."""
        return 1


class Slurm:
    """Starts workers as jobs of the Slurm cluster of this machine.

    Args:
        folder: the folder of the workers' logs, with %j for a job's number.
        options: what the jobs are asked for with.

    Raises:
        InputError: where there is no Slurm.
    """

    def __init__(self, folder: Path, options: SlurmOptions):
        with explained("slurm"):
            self.executor = SlurmExecutor(folder=folder, python=options.python)
            self.executor.set(options)
        self.gpus = options.gpu

    def submit(self, work: Work, count: int = 1) -> list[Submitted]:
        """Start workers as one job array. Raises InputError where sbatch refuses an option."""
        with explained("slurm"):
            with self.executor.batch():
                jobs: list[Any] = [self.executor.submit(Requeued(work)) for _ in range(count)]
            return [Submitted(job) for job in jobs]


def script(folder: Path, options: SlurmOptions, workers: int) -> str:
    """Return the file that sbatch would be given for so many workers; Slurm need not be installed."""
    executor = Unsent(folder=folder, python=options.python)
    executor.set(options)
    if workers > 1:
        executor.parameters["map_count"] = workers
    return executor._make_submission_file_text(executor._submitit_command_str, "worker")
