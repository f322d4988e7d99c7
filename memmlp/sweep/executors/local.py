"""Workers that are processes of this machine."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Iterator, Sequence
from pathlib import Path

import submitit
from submitit.core.utils import JobPaths
from submitit.local import local

from memmlp.common.processes import children_import_the_same
from memmlp.sweep.executors.executor import Work
from memmlp.sweep.executors.gpus import Share
from memmlp.sweep.executors.submitit_jobs import UNLIMITED, Requeued, Submitted, explained


class SubmititLocal(submitit.LocalExecutor):
    """Submitit's executor of local processes, which would hide all GPUs from them.

    Attributes:
        gpus: the GPUs that the next process may use.
    """

    gpus: Share = ()

    def _submit_command(self, command: str) -> local.LocalJob:
        visible = ",".join(self.gpus)
        logs = JobPaths.get_first_id_independent_folder(self.folder)
        with _stderr_to(logs / "controllers.err"):  # they die of Ctrl-C with a traceback
            process = local.start_controller(
                self.folder, command, cuda_devices=visible, timeout_min=UNLIMITED
            )
        return local.LocalJob(self.folder, str(process.pid), process=process)


class Local:
    """Starts workers as processes of this machine, each with its share of the GPUs.

    Args:
        folder: the folder of the workers' logs, with %j for a worker's number.
        shared: the shares of GPUs that workers may have; empty for workers without GPUs.
    """

    def __init__(self, folder: Path, shared: Sequence[Share] = ()):
        with explained("local"):
            self.executor = SubmititLocal(folder=folder)
        self.shared = list(shared) or [()]
        self.gpus = bool(shared)
        self.started: list[tuple[Submitted, int]] = []

    def submit(self, work: Work, count: int = 1) -> list[Submitted]:
        """Start workers, each with the share of GPUs that has the fewest living workers."""
        return [self._start(work) for _ in range(count)]

    def _start(self, work: Work) -> Submitted:
        self.started = [(worker, number) for worker, number in self.started if worker.alive()]
        users = [number for _, number in self.started]
        least = min(range(len(self.shared)), key=users.count)
        self.executor.gpus = self.shared[least]
        with _interruptible(), children_import_the_same():
            worker = Submitted(self.executor.submit(Requeued(work)))
        self.started.append((worker, least))
        return worker


@contextlib.contextmanager
def _interruptible() -> Iterator[None]:
    """Let processes that start in the context receive SIGINT, by which submitit cancels, even under nohup."""
    before = signal.getsignal(signal.SIGINT)
    if before is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        yield
    finally:
        if before is signal.SIG_IGN:
            signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextlib.contextmanager
def _stderr_to(path: Path) -> Iterator[None]:
    """Append to a file what processes that are started within the context write to stderr."""
    before = os.dup(2)
    try:
        with path.open("ab") as file:
            os.dup2(file.fileno(), 2)
        yield
    finally:
        os.dup2(before, 2)
        os.close(before)


class Debug:
    """Runs the work inside this process, at the moment when the worker is first asked whether it is alive."""

    gpus = False

    def __init__(self, folder: Path):
        with explained("debug"):
            self.executor = submitit.DebugExecutor(folder=folder)

    def submit(self, work: Work, count: int = 1) -> list[Submitted]:
        """Make workers that do their work when they are first asked whether they are alive."""
        return [Submitted(self.executor.submit(Requeued(work))) for _ in range(count)]
