"""Workers that are jobs of a Slurm cluster, submitted as job arrays.

Whether a job is in the queue is read from `squeue`, since many clusters keep no accounts for `sacct`. Whether
its worker lives is read from the worker's heartbeat, since Slurm overlooks some dead steps for hours.
"""

import math
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from memmlp.common.errors import InputError
from memmlp.common.lease import ChangeTimer
from memmlp.common.processes import build_import_variables
from memmlp.sweep.executors import Work
from memmlp.sweep.executors.local import HEARTBEAT, name_folder, prepare_work, read_complaint

QUEUE_INTERVAL = 10.0  # seconds between two calls of squeue
SILENCE = 45.0  # seconds without a heartbeat after which a worker counts as dead
PATIENCE = 60.0  # seconds until a command of Slurm counts as failed
HELD = "launch failed requeued held"  # Slurm's reason for a job that it does not start again by itself
WARNING = 90  # seconds before the time limit at which a job is queued again; Slurm may be a minute early
MIN_WARNED_MINUTES = 4  # a shorter job has no time for the warning
KEPT_VARIABLES = ("SLURM_CONF", "SLURM_CLUSTERS")  # others describe this process' job, not the worker's

TIME = re.compile(r"(?:(?P<days>\d+)-)?(?P<first>\d+)(?::(?P<second>\d+))?(?::(?P<third>\d+))?")
RESERVED = ("array", "output", "error", "open_mode", "signal", "wrap", "wait", "parsable", "test_only")
FIXED_TO_ONE = ("nodes", "ntasks", "ntasks_per_node", "ntasks_per_gpu")  # since a worker is one task


@dataclass(frozen=True)
class SlurmOptions:
    """The options of submitted jobs: sbatch's `parameters` by long name, with _ in place of -, True for an
    option without a value; arguments for srun, which starts the worker inside the job; a shell command that
    each job runs first; the command that starts Python in the job, None for the Python of this process; and
    the time limit in minutes."""

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
    """Return the options for settings `slurm.KEY=VALUE`. Raises InputError for an invalid value, and for an
    option that memmlp sets itself."""
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
        reason = "cannot be set, because a worker is one task on one node"
        raise InputError(f"slurm.{key}: {reason}; use --workers N")
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


class Queue:
    """The queued and running jobs of this user, read at most every QUEUE_INTERVAL."""

    def __init__(self, clusters: Sequence[str]):
        options = ["--noheader", "--array", f"--user={os.getuid()}", "--format=%i %T %r"]
        self.command = ["squeue", *options, *clusters]
        self.states: dict[str, str] | None = None
        self.read_time = -math.inf

    def find_state(self, job: str) -> str | None:
        """Return the state of a job with its reason, such as "PENDING Priority"; "" after the job's end, None
        while Slurm does not answer."""
        if time.monotonic() - self.read_time > QUEUE_INTERVAL:
            lines = call_slurm(self.command)
            self.states = None if lines is None else dict(line.split(" ", 1) for line in lines if " " in line)
            self.read_time = time.monotonic()
        return None if self.states is None else self.states.get(job, "")


class Job:
    """A worker that is a job of Slurm, with a name such as 42_0. `clusters` is the option for Slurm's
    commands that chooses the cluster, or empty."""

    def __init__(self, name: str, folder: Path, queue: Queue, clusters: Sequence[str]):
        self.name, self.folder, self.queue, self.clusters = name, folder, queue, clusters
        self._timer = ChangeTimer()

    def alive(self) -> bool:
        """Return whether the job waits or works. A job that Slurm lists is cancelled if its worker began and
        is silent: Slurm did not notice its death, or has queued the job again, where it waits for minutes. A
        job that failed to start is also cancelled: Slurm holds it for ever."""
        state = self.queue.find_state(self.name)
        if state == "":
            return False
        if state is not None and HELD in state:
            self.cancel()
            return False
        is_suspended = state is not None and state.startswith("SUSPENDED")
        if not self.began or is_suspended or self._count_silent_seconds() < SILENCE:
            return True
        self.cancel()
        return False

    @property
    def began(self) -> bool:
        return (self.folder / HEARTBEAT).exists()

    def _count_silent_seconds(self) -> float:
        def read() -> int:
            with open(self.folder / HEARTBEAT, "rb") as file:  # on NFS, opening refreshes it from the server
                return os.fstat(file.fileno()).st_mtime_ns

        return self._timer.seconds_unchanged(self.name, read)

    def cancel(self) -> None:
        call_slurm(["scancel", *self.clusters, self.name])

    def complaint(self) -> str | None:
        if not self.began:
            return f"job {self.name} ended before its worker began"
        return read_complaint(self.folder)


class Slurm:
    """Starts workers as jobs of the Slurm cluster of this machine. `folder` is that of the workers' logs,
    with %j in place of a name. Raises InputError if Slurm is not installed, or could not use the folder."""

    def __init__(self, folder: Path, options: SlurmOptions):
        _check_folder(folder)
        if not shutil.which("sbatch"):
            raise InputError("executor=slurm: Slurm is not installed on this machine (sbatch not found)")
        self.folder, self.options = folder, options
        self.gpus = options.gpu
        clusters = options.parameters.get("clusters")
        self.clusters = [f"--clusters={clusters}"] if clusters else []
        self.queue = Queue(self.clusters)

    def submit(self, work: Work, count: int = 1) -> list[Job]:
        """Start workers as a job array. Raises InputError if Slurm does not answer, or rejects them."""
        folder = name_folder(self.folder)
        for number in range(count):
            prepare_work(work, folder / str(number))
        script = folder / "job.sh"
        script.write_text(format_batch_script(folder, self.options, count), encoding="utf-8")
        of_job = {name for name in os.environ if name.startswith(("SLURM_", "SRUN_"))} - {*KEPT_VARIABLES}
        outside = {name: value for name, value in os.environ.items() if name not in of_job}
        try:
            command = ["sbatch", str(script)]
            done = subprocess.run(command, env=outside, capture_output=True, text=True, timeout=PATIENCE)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise InputError(f"executor=slurm: sbatch: {error}") from None
        job = re.search(r"job (\d+)", done.stdout)
        if done.returncode or not job:
            raise InputError(f"executor=slurm: {' '.join((done.stderr or done.stdout).split())}")
        self.queue.read_time = -math.inf  # it was read before these jobs
        names = [(f"{job[1]}_{number}", folder / str(number)) for number in range(count)]
        return [Job(name, place, self.queue, self.clusters) for name, place in names]


def call_slurm(command: Sequence[str]) -> list[str] | None:
    """Return the output lines of a command of Slurm; None if it fails or does not answer."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.splitlines() if done.returncode == 0 else None


def format_batch_script(folder: Path, options: SlurmOptions, workers: int) -> str:
    """Return the text of the sbatch script for this number of workers, also on machines without Slurm. Worker
    N has the subfolder N of the folder. A job queues itself again before its time limit, so that the runs go
    on also without a controller."""
    _check_folder(folder)
    parameters: dict[str, str | bool] = {"job_name": "memmlp", "requeue": True, **options.parameters}
    parameters |= {"array": f"0-{workers - 1}", "output": f"{folder}/%a/log.txt", "open_mode": "append"}
    requeues = options.minutes >= MIN_WARNED_MINUTES and "no_requeue" not in parameters
    if "no_requeue" in parameters:
        del parameters["requeue"]
    if requeues:
        parameters["signal"] = f"B:USR2@{WARNING}"
    lines = ["#!/bin/bash"]
    for key, value in parameters.items():
        quoted = shlex.quote(str(value)).replace("\\", "\\\\")  # sbatch removes single backslashes
        text = "" if value is True else f"={quoted}"
        lines.append(f"#SBATCH --{key.replace('_', '-')}{text}")
    lines += [options.setup] if options.setup else []
    if options.python is None:  # another Python has its own packages
        lines += [f"export {name}={shlex.quote(value)}" for name, value in build_import_variables().items()]
    lines.append('[ -z "$SLURM_CPUS_PER_TASK" ] || export SRUN_CPUS_PER_TASK="$SLURM_CPUS_PER_TASK"')
    lines += ["trap 'scontrol requeue \"$SLURM_JOB_ID\"' USR2"] if requeues else []
    python = shlex.quote(sys.executable) if options.python is None else options.python
    place = f"{shlex.quote(str(folder))}/$SLURM_ARRAY_TASK_ID"
    start = f"{python} -u -m memmlp.sweep.executors.local {place} beat"
    # bash handles the signal only between commands, or during `wait`, which the signal ends.
    lines += [f"{shlex.join(['srun', *options.srun])} {start} &", "wait $! || wait $!"]
    return "\n".join(lines) + "\n"


def _check_folder(folder: Path) -> None:
    """Raise InputError for a folder with characters that Slurm would replace in log paths."""
    path = folder.absolute().parent
    if not str(path).isprintable() or set(str(path)) & {*"%\\"}:
        raise InputError(f"executor=slurm: {path}: must not contain % or \\ or control characters; rename it")
