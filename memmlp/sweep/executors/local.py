"""Workers that are processes of this machine, and how its GPUs are divided among them."""

from __future__ import annotations

import itertools
import os
import pickle
import subprocess
import sys
import threading
import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path

from memmlp.common.errors import InputError
from memmlp.common.processes import (
    build_import_variables,
    collect_garbage_rarely,
    treat_termination_as_interrupt,
)
from memmlp.sweep.executors import Work

VISIBLE = "CUDA_VISIBLE_DEVICES"
WORK, LINE = "work.pickle", "line.txt"  # files of a worker's folder: its work, and the line that it returns

Share = tuple[str, ...]
"""The GPUs of one worker, by their names in CUDA_VISIBLE_DEVICES; empty for a worker without GPUs."""


def visible_gpus() -> Share:
    """Return the names of the GPUs that this process may use, in the form of CUDA_VISIBLE_DEVICES.

    As in CUDA, a name below 0 hides that entry and all that follow.
    """
    text = os.environ.get(VISIBLE)
    if text is None:
        import torch

        return tuple(map(str, range(torch.cuda.device_count())))
    names = [name.strip() for name in text.split(",") if name.strip()]
    return tuple(itertools.takewhile(lambda name: not name.startswith("-"), names))


def divide_gpus(gpus: Share, per_worker: int | None = None) -> list[Share]:
    """Divide the GPUs into shares of `per_worker` GPUs, one share for each worker; a remainder is idle.

    Args:
        gpus: the visible GPUs.
        per_worker: GPUs of a worker; None for 1 if there are GPUs. With 0 there are no shares.

    Raises:
        InputError: if a worker would have more GPUs than there are.
    """
    size = per_worker if per_worker is not None else min(len(gpus), 1)
    if size > len(gpus):
        names = ", ".join(gpus) or "no GPU"
        raise InputError(f"--gpus-per-worker {size}: must be at most {len(gpus)}; visible here: {names}")
    return [gpus[i : i + size] for i in range(0, len(gpus) - size + 1, size)] if size else []


def worker_count(shares: Sequence[Share], workers: int | None, per_gpu: int | None) -> int:
    """Return how many workers run at once.

    Args:
        shares: the shares of GPUs that a worker may get; empty if workers have no GPUs.
        workers: how many were asked for; None for one per core, or with GPUs one per share.
        per_gpu: the largest number of workers per share; None for as many as are needed.

    Raises:
        InputError: if that is more than the shares allow, or if there are no GPUs to share.
    """
    if not shares:
        if per_gpu:
            raise InputError(f"--workers-per-gpu {per_gpu}: there are no GPUs for workers here")
        return workers or os.cpu_count() or 1
    most = len(shares) * (per_gpu or 1)
    if workers and per_gpu and workers > most:
        raise InputError(f"--workers {workers}: must be at most {most} with --workers-per-gpu {per_gpu}")
    return workers or most


class Worker:
    """A worker that is a process of this machine."""

    def __init__(self, process: subprocess.Popen[bytes], folder: Path):
        self.process, self.folder = process, folder
        threading.Thread(target=process.wait, daemon=True).start()  # so that it leaves no zombie

    def alive(self) -> bool:
        """Return whether the process is working."""
        return self.process.poll() is None

    def cancel(self) -> None:
        """Ask the process to end; it releases the run that it is working on."""
        self.process.terminate()

    def complaint(self) -> str | None:
        """Return the worker's own line about why it could do no work; None after any other end."""
        path = self.folder / LINE
        return path.read_text(encoding="utf-8") if path.exists() else None


class Local:
    """Starts workers as processes of this machine, each with its share of the GPUs.

    Args:
        folder: the folder of the workers' logs, with %j for a worker's name.
        shares: the shares of GPUs that workers may have; empty for workers without GPUs.
    """

    def __init__(self, folder: Path, shares: Sequence[Share] = ()):
        self.folder = folder
        self.shares = list(shares) or [()]
        self.gpus = bool(shares)
        self.workers: list[tuple[Worker, int]] = []

    def submit(self, work: Work, count: int = 1) -> list[Worker]:
        """Start workers, each with the share of GPUs that has the fewest living workers."""
        return [self._start(work) for _ in range(count)]

    def _start(self, work: Work) -> Worker:
        self.workers = [(worker, number) for worker, number in self.workers if worker.alive()]
        users = [number for _, number in self.workers]
        least = min(range(len(self.shares)), key=users.count)
        folder = Path(str(self.folder).replace("%j", uuid.uuid4().hex[:12]))
        process = start_process(work, folder, {VISIBLE: ",".join(self.shares[least])})
        self.workers.append((Worker(process, folder), least))
        return self.workers[-1][0]


def start_process(
    work: Work, folder: Path, environment: Mapping[str, str], with_parent: bool = False
) -> subprocess.Popen[bytes]:
    """Start a Python process that does the work, with its output in the folder's `log.txt`.

    Args:
        work: the work; the line that it returns is written to the file LINE.
        folder: a new folder.
        environment: further variables of the process' environment.
        with_parent: whether it ends when this process ends.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / WORK).write_bytes(pickle.dumps(work))
    command = [sys.executable, "-u", "-m", __name__, str(folder), *(["follow"] if with_parent else [])]
    with open(folder / "log.txt", "ab") as log:
        return subprocess.Popen(
            command,
            env={**os.environ, **build_import_variables(), **environment},
            stdin=subprocess.PIPE if with_parent else subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            start_new_session=True,  # Ctrl-C reaches only the controller, which ends its workers
        )


def do_work(folder: Path) -> None:
    """Do the work of a worker's folder, in a process of its own."""
    collect_garbage_rarely()
    work: Work = pickle.loads((folder / WORK).read_bytes())
    (folder / WORK).unlink()
    with treat_termination_as_interrupt():
        line = work()
    if line is not None:
        (folder / LINE).write_text(line, encoding="utf-8")


def _end_with_parent() -> None:
    while os.read(sys.stdin.fileno(), 1):  # past Python's buffer, for which the end of the process waits
        pass
    os._exit(1)


class DebugWorker:
    """A worker that works inside this process, when it is first asked whether it is alive."""

    def __init__(self, work: Work):
        self.work: Work | None = work
        self.line: str | None = None

    def alive(self) -> bool:
        """Do the work if it has not been done, and return False."""
        if self.work:
            work, self.work = self.work, None
            self.line = work()
        return False

    def cancel(self) -> None:
        """Do nothing: the work is done, or never begins."""

    def complaint(self) -> str | None:
        """Return the line that the work returned."""
        return self.line


class Debug:
    """Runs workers inside this process, for debuggers."""

    gpus = False

    def submit(self, work: Work, count: int = 1) -> list[DebugWorker]:
        """Make workers that do their work when they are first asked whether they are alive."""
        return [DebugWorker(work) for _ in range(count)]


if __name__ == "__main__":
    if sys.argv[2:]:
        threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        do_work(Path(sys.argv[1]))
    except KeyboardInterrupt:
        sys.exit(130)
