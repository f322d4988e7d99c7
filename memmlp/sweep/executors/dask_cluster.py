"""Workers that are tasks of a Dask cluster, each in a separate process.

Dask runs tasks in threads of a process. Threads would share torch's random numbers and thread count, and
cannot be ended. Therefore each task starts a process and monitors it.
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
"""The settings `dask.KEY`. `address`: the scheduler's address, by default DASK_SCHEDULER_ADDRESS.
`resources.NAME`: the amount of a Dask resource that each memmlp worker takes."""
GPU = "GPU"  # the resource with which Dask workers declare their GPU
PAUSE = 1.0  # seconds between two checks for the stop event


class DaskTask:
    """A worker that is a task in Dask.

    Args:
        future: the task.
        stop: the `distributed.Event` that makes the task end its process.
    """

    def __init__(self, future: Any, stop: Any):
        self.future, self.stop = future, stop

    def alive(self) -> bool:
        """Return whether the task is waiting or working."""
        return self.future.status == "pending"

    def cancel(self) -> None:
        """End the task's process, or cancel the task if it is still waiting."""
        self.stop.set()
        self.future.cancel()

    def complaint(self) -> str | None:
        """Return the line that explains why the worker could not work; None after any other end."""
        return self.future.result() if self.future.status == "finished" else None


class Dask:
    """Starts workers as tasks of a running Dask cluster.

    Args:
        options: the parsed SETTINGS.
        gpus: whether workers get a GPU if the cluster declares GPUs; the option `resources.GPU` has priority.

    Raises:
        InputError: if Dask is not installed, the address is missing, or the cluster cannot be reached.
    """

    def __init__(self, options: Mapping[str, Any], gpus: bool = True):
        self.distributed: Any = import_optional("distributed", "dask", "executor=dask")
        address = options.get("address") or os.environ.get("DASK_SCHEDULER_ADDRESS")
        if not address:
            raise InputError("executor=dask: expected the scheduler's address, dask.address=HOST:PORT")
        try:
            self.client = self.distributed.Client(address, set_as_default=False)
        except (OSError, ValueError) as error:
            raise InputError(f"dask.address={address}: {' '.join(str(error).split())}") from None
        workers = self.client.scheduler_info(n_workers=-1)["workers"].values()
        declared = any(GPU in one["resources"] for one in workers)
        self.resources = ({GPU: 1.0} if gpus and declared else {}) | options.get("resources", {})
        self.gpus = self.resources.get(GPU, 0) > 0
        if gpus and not self.gpus:
            line = "no Dask worker declares a GPU, so runs use no GPU (dask worker --resources GPU=1)"
            print(f"memmlp: executor=dask: {line}", file=sys.stderr, flush=True)

    def submit(self, work: Work, count: int = 1) -> list[DaskTask]:
        """Start workers. A worker waits until the cluster has its resources."""
        started = []
        for _ in range(count):
            name = f"memmlp-{uuid.uuid4().hex}"
            resources = {"resources": dict(self.resources)} if self.resources else {}
            future = self.client.submit(
                _run_in_separate_process, work, name, self.gpus, key=name, pure=False, **resources
            )
            started.append(DaskTask(future, self.distributed.Event(name, self.client)))
        return started


def _run_in_separate_process(work: Work, stop: str, gpus: bool) -> str | None:
    """Do the work in a separate process, which ends with this process or when the event `stop` is set."""
    from distributed import Event, get_worker

    declared = get_worker().state.total_resources.get(GPU, 0)
    if gpus and declared > 1:  # Dask does not assign a certain GPU to the task
        return f"a Dask worker declares {declared:g} GPUs; expected 1, with CUDA_VISIBLE_DEVICES set for it"
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
