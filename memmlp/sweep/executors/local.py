"""Workers that are processes of this machine, and the division of its GPUs among workers."""

import contextlib
import itertools
import os
import pickle
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

from memmlp.common.errors import InputError
from memmlp.common.processes import (
    build_import_variables,
    collect_garbage_rarely,
    count_usable_cores,
    treat_termination_as_interrupt,
)
from memmlp.common.text_formats import print_in_any_encoding
from memmlp.sweep.executors import Work

VISIBLE = "CUDA_VISIBLE_DEVICES"
WORK, LINE = "work.pickle", "line.txt"  # files of a worker's folder: the pickled work, and the returned line
LOG, HEARTBEAT = "log.txt", "heartbeat"  # further files: the worker's output; touched every BEAT if requested
BEAT = 5.0  # seconds

GpuGroup = tuple[str, ...]
"""The names, as in CUDA_VISIBLE_DEVICES, of a worker's GPUs; empty for a worker without GPUs."""


def list_visible_gpus() -> GpuGroup:
    """Return the names of the GPUs that this process may use, as in CUDA_VISIBLE_DEVICES. Like in CUDA, a
    negative number hides its entry and all later entries."""
    text = os.environ.get(VISIBLE)
    if text is None:
        if version("torch").endswith("+cpu"):  # torch's import takes 1 s
            return ()
        import torch

        return tuple(map(str, range(torch.cuda.device_count())))
    names = [name.strip() for name in text.split(",") if name.strip()]
    return tuple(itertools.takewhile(lambda name: not name.startswith("-"), names))


def divide_gpus(gpus: GpuGroup, per_worker: int | None = None) -> list[GpuGroup]:
    """Divide the GPUs into groups of `per_worker` GPUs (None for 1, 0 for no groups), one group for each
    worker. The rest stays idle. Raises InputError if `per_worker` is greater than the number of GPUs."""
    size = per_worker if per_worker is not None else min(len(gpus), 1)
    if size > len(gpus):
        visible = f"the number of visible GPUs ({', '.join(gpus) or 'no GPU'})"
        raise InputError(f"--gpus-per-worker {size}: must be at most {len(gpus)}, {visible}")
    return [gpus[i : i + size] for i in range(0, len(gpus) - size + 1, size)] if size else []


def count_workers(gpu_groups: Sequence[GpuGroup], workers: int | None, per_gpu: int | None) -> int:
    """Return the number of workers that run at once: `workers`, or None for one per GPU group, or without
    GPUs one per core. Raises InputError if there are more than `per_gpu` per GPU group, or if `per_gpu` is
    given without GPUs; None sets no limit."""
    if not gpu_groups:
        if per_gpu:
            raise InputError(f"--workers-per-gpu {per_gpu}: this machine has no GPUs for workers")
        return workers or count_usable_cores()
    most = len(gpu_groups) * (per_gpu or 1)
    if workers and per_gpu and workers > most:
        raise InputError(f"--workers {workers}: must be at most {most} with --workers-per-gpu {per_gpu}")
    return workers or most


class Worker:
    """A worker that is a process of this machine. It releases its run before it ends."""

    def __init__(self, process: subprocess.Popen[bytes], folder: Path):
        self.process, self.folder = process, folder
        threading.Thread(target=process.wait, daemon=True).start()  # reaps the process

    def alive(self) -> bool:
        return self.process.poll() is None

    def cancel(self) -> None:
        self.process.terminate()

    def complaint(self) -> str | None:
        return read_complaint(self.folder)


class LocalExecutor:
    """Starts workers as processes of this machine, each with one of the GPU groups; without groups, they have
    no GPUs. `folder` is that of the workers' logs, with %j in place of a worker's name."""

    def __init__(self, folder: Path, gpu_groups: Sequence[GpuGroup] = ()):
        self.folder = folder
        self.gpu_groups = list(gpu_groups) or [()]
        self.gpus = bool(gpu_groups)
        self.workers: list[tuple[Worker, int]] = []

    def submit(self, work: Work, count: int = 1) -> list[Worker]:
        """Start workers, each with the GPU group that has the fewest living workers."""
        return [self._start(work) for _ in range(count)]

    def _start(self, work: Work) -> Worker:
        self.workers = [(worker, number) for worker, number in self.workers if worker.alive()]
        users = [number for _, number in self.workers]
        least = min(range(len(self.gpu_groups)), key=users.count)
        folder = name_folder(self.folder)
        process = start_process(work, folder, {VISIBLE: ",".join(self.gpu_groups[least])})
        self.workers.append((Worker(process, folder), least))
        return self.workers[-1][0]


def name_folder(pattern: Path) -> Path:
    """Return a new path for a worker: `pattern` with a random name in place of %j."""
    return pattern.with_name(pattern.name.replace("%j", uuid.uuid4().hex[:12]))


def prepare_work(work: Work, folder: Path) -> None:
    """Make a worker's folder with the work that its process does."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / WORK).write_bytes(pickle.dumps(work))


def read_complaint(folder: Path) -> str | None:
    """Return the line that the work in a worker's folder returned; None without one."""
    path = folder / LINE
    return path.read_text(encoding="utf-8") if path.exists() else None


def start_process(work: Work, folder: Path, environment: Mapping[str, str]) -> subprocess.Popen[bytes]:
    """Start a Python process that does the work, with additional environment variables, and its output in the
    `log.txt` of the new folder. A returned line is written to the file LINE."""
    prepare_work(work, folder)
    with open(folder / LOG, "ab") as log:
        return subprocess.Popen(
            [sys.executable, "-u", "-m", __name__, str(folder)],
            env={**os.environ, **build_import_variables(), **environment},
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            start_new_session=True,  # Ctrl-C reaches only the controller, which then ends its workers
        )


def do_work(folder: Path) -> None:
    """Do the work that is pickled in a worker's folder. It is called in the worker's process. The pickle is
    kept, because a cluster may start the worker again."""
    collect_garbage_rarely()
    print_in_any_encoding()
    work: Work = pickle.loads((folder / WORK).read_bytes())
    with treat_termination_as_interrupt():
        line = work()
    if line is not None:
        (folder / LINE).write_text(line, encoding="utf-8")


def _beat(folder: Path) -> None:
    """Touch the heartbeat from now on, and write the output to the log, also after the death of srun."""
    with open(folder / LOG, "ab") as log:
        for stream in (sys.stdout, sys.stderr):
            os.dup2(log.fileno(), stream.fileno())

    def touch_regularly() -> None:
        while True:
            with contextlib.suppress(OSError):  # the disk may be full
                (folder / HEARTBEAT).touch()
            time.sleep(BEAT)

    threading.Thread(target=touch_regularly, daemon=True).start()


class DebugWorker(NamedTuple):
    """A worker that has done its work in this process, and the returned line."""

    line: str | None

    def alive(self) -> bool:
        return False

    def cancel(self) -> None:
        pass

    def complaint(self) -> str | None:
        return self.line


class DebugExecutor:
    """Runs workers inside this process, for debuggers."""

    gpus = False

    def submit(self, work: Work, count: int = 1) -> list[DebugWorker]:
        return [DebugWorker(work()) for _ in range(count)]


if __name__ == "__main__":
    if "beat" in sys.argv[2:]:
        _beat(Path(sys.argv[1]))
    try:
        do_work(Path(sys.argv[1]))
    except KeyboardInterrupt:
        sys.exit(130)
