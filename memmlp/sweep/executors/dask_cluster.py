"""Workers that are tasks of a Dask cluster, each with a process of its own.

Dask runs tasks in threads of one process, where they would share torch's random numbers and number of
threads, and could not be ended. So each task starts a process and watches it.
"""

from __future__ import annotations

import os
import sys
import tempfile
import uuid
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from memmlp.common.errors import InputError, import_optional
from memmlp.sweep.executors import Work, parse_amount
from memmlp.sweep.executors.local import LINE, VISIBLE, start_process

SETTINGS: Mapping[str, Callable[[str], Any]] = {"address": str, "resources.NAME": parse_amount}
"""The settings `dask.KEY`: the scheduler's address, by default that in DASK_SCHEDULER_ADDRESS; and how much
each of our workers takes of the resources of Dask's workers, by name."""
GPU = "GPU"  # the resource by which Dask's workers declare their GPU
PAUSE = 1.0  # seconds between checks whether a worker is to be ended


class DaskTask:
    """A worker that is a task in Dask.

    Args:
        future: the task.
        stop: the event (`distributed.Event`) upon which the task ends its process.
    """

    def __init__(self, future: Any, stop: Any):
        self.future, self.stop = future, stop

    def alive(self) -> bool:
        """Return whether the task is waiting or working."""
        return self.future.status == "pending"

    def cancel(self) -> None:
        """End the task's process, or withdraw the task if it is still waiting."""
        self.stop.set()
        self.future.cancel()

    def complaint(self) -> str | None:
        """Return the worker's own line about why it could do no work; None after any other end."""
        return self.future.result() if self.future.status == "finished" else None


class Dask:
    """Starts workers as tasks of a running Dask cluster.

    Args:
        options: the parsed SETTINGS.
        gpus: whether workers get a GPU, if the options do not say so and the cluster declares GPUs.

    Raises:
        InputError: if Dask is not installed, or the cluster is not named or can't be reached.
    """

    def __init__(self, options: Mapping[str, Any], gpus: bool = True):
        self.distributed: Any = import_optional("distributed", "dask", "executor=dask")
        address = options.get("address") or os.environ.get("DASK_SCHEDULER_ADDRESS")
        if not address:
            raise InputError("executor=dask: dask.address=HOST:PORT of a scheduler is missing")
        try:
            self.client = self.distributed.Client(address, set_as_default=False)
        except (OSError, ValueError) as error:
            raise InputError(f"dask.address={address}: {' '.join(str(error).split())}") from None
        workers = self.client.scheduler_info(n_workers=-1)["workers"].values()
        declared = any(GPU in one["resources"] for one in workers)
        self.resources = ({GPU: 1.0} if gpus and declared else {}) | options.get("resources", {})
        self.gpus = self.resources.get(GPU, 0) > 0
        if gpus and not self.gpus:
            line = "no worker declares a GPU (dask worker --resources GPU=1): runs have none"
            print(f"memmlp: executor=dask: {line}", file=sys.stderr, flush=True)

    def submit(self, work: Work, count: int = 1) -> list[DaskTask]:
        """Start workers; those that the cluster has no resources for wait."""
        started = []
        for _ in range(count):
            name = f"memmlp-{uuid.uuid4().hex}"
            wanted = {"resources": dict(self.resources)} if self.resources else {}
            future = self.client.submit(_work_apart, work, name, self.gpus, key=name, pure=False, **wanted)
            started.append(DaskTask(future, self.distributed.Event(name, self.client)))
        return started


def _work_apart(work: Work, stop: str, gpus: bool) -> str | None:
    """Do the work in a separate process, which ends with this one, or when the event `stop` is set."""
    from distributed import Event, get_worker

    declared = get_worker().state.total_resources.get(GPU, 0)
    if gpus and declared > 1:  # it is unknown which of them is this task's
        return f"a Dask worker declares {declared:g} GPUs; must be one, each with its CUDA_VISIBLE_DEVICES"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with start_process(work, folder, {} if gpus else {VISIBLE: ""}, with_parent=True) as process:
            while process.poll() is None:
                if Event(stop).wait(PAUSE):
                    process.kill()
        if process.returncode:
            log = (folder / "log.txt").read_text(encoding="utf-8", errors="replace").strip()
            raise RuntimeError(f"the worker's process ended with {process.returncode}: {log[-2000:]}")
        line = folder / LINE
        return (line.read_text(encoding="utf-8") if line.exists() else None) or None
