"""Workers that are tasks of a Dask cluster, each with a process of its own.

Dask runs tasks in threads of one process, where they would share torch's random numbers and number of
threads, and could not be ended. So each task starts a process and looks after it.
"""

from __future__ import annotations

import math
import os
import pickle
import subprocess
import sys
import tempfile
import threading
import uuid
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from memmlp.common.errors import InputError
from memmlp.common.processes import import_environment
from memmlp.sweep.executors.executor import Work
from memmlp.sweep.executors.gpus import VISIBLE

KEYS = ("address", "resources.NAME")
GPU = "GPU"  # the resource by which Dask's workers say that they have a GPU
PAUSE = 1.0  # seconds between looks at whether a worker is to be ended


@dataclass(frozen=True)
class DaskOptions:
    """Which cluster is used, and what each worker requests from it.

    Attributes:
        address: the scheduler's address; None for the address in DASK_SCHEDULER_ADDRESS.
        resources: how much each of our workers takes of the resources of Dask's workers, by name.
    """

    address: str | None = None
    resources: Mapping[str, float] = field(default_factory=dict)


def dask_options(words: Mapping[str, str]) -> DaskOptions:
    """Return the options in the words `dask.KEY=VALUE` of a command line.

    Raises:
        InputError: for an unknown key or a value of the wrong kind.
    """
    resources = {}
    for key, value in words.items():
        name = key.removeprefix("resources.")
        if name != key and not value.replace(".", "", 1).isdecimal():
            raise InputError(f"dask.{key}={value}: allowed is a number, at least 0")
        if name == key and key != "address":
            raise InputError(f"dask.{key}: no such key; allowed here: {', '.join(KEYS)}")
        if name != key:
            resources[name] = float(value)
    return DaskOptions(words.get("address"), resources)


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
        options: the cluster, and what each worker requests from it.
        gpus: whether workers get a GPU, if the options leave it open and the cluster declares GPUs.

    Raises:
        InputError: if Dask is not installed, or the cluster is not named or can't be reached.
    """

    def __init__(self, options: DaskOptions, gpus: bool = True):
        try:
            from distributed import Client
        except ImportError:
            raise InputError("executor=dask: Dask is not installed; pip install 'memmlp[dask]'") from None
        address = options.address or os.environ.get("DASK_SCHEDULER_ADDRESS")
        if not address:
            raise InputError("executor=dask: dask.address=HOST:PORT of a scheduler is missing")
        try:
            self.client = Client(address, set_as_default=False)
        except (OSError, ValueError) as error:
            raise InputError(f"dask.address={address}: {' '.join(str(error).split())}") from None
        declared = any(GPU in there for there in self._declared())
        self.resources = ({GPU: 1.0} if gpus and declared else {}) | dict(options.resources)
        self.gpus = self.resources.get(GPU, 0) > 0
        self.tasks: list[DaskTask] = []
        if gpus and not self.gpus:
            _say("no worker declares a GPU (dask worker --resources GPU=1): runs have none")
        if not self._room():
            asked = ", ".join(f"{amount:g} {name}" for name, amount in self.resources.items())
            _say(f"no worker of the cluster has {asked}; runs wait until one comes")

    def submit(self, work: Work, count: int = 1) -> list[DaskTask]:
        """Start workers, but no more than the cluster has room for at present.

        Dask would assign further ones to busy workers, and leave them there even when other workers become
        free.
        """
        self.tasks = [task for task in self.tasks if task.alive()]
        free = max(self._room() - len(self.tasks), 0)
        made = [self._submit(work, f"memmlp-{uuid.uuid4().hex}") for _ in range(int(min(count, free)))]
        self.tasks += made
        return made

    def _room(self) -> float:
        """Return how many of our workers can have their resources at once; infinite if they need none."""
        asked = {name: amount for name, amount in self.resources.items() if amount}
        if not asked:
            return math.inf
        every = self._declared()
        return sum(min(there.get(name, 0) // amount for name, amount in asked.items()) for there in every)

    def _declared(self) -> list[Mapping[str, float]]:
        """Return the resources that each of the cluster's workers declares."""
        return [one["resources"] for one in self.client.scheduler_info(n_workers=-1)["workers"].values()]

    def _submit(self, work: Work, name: str) -> DaskTask:
        from distributed import Event

        wanted = {"resources": dict(self.resources)} if self.resources else {}
        future = self.client.submit(_apart, work, name, self.gpus, key=name, pure=False, **wanted)
        return DaskTask(future, Event(name, self.client))


def _say(line: str) -> None:
    print(f"memmlp: executor=dask: {line}", file=sys.stderr, flush=True)


def _apart(work: Work, stop: str, gpus: bool) -> str | None:
    """Do the work in a separate process, which ends with this one, or when the event `stop` is set."""
    from distributed import Event, get_worker

    declared = get_worker().state.total_resources.get(GPU, 0)
    if gpus and declared > 1:  # nobody would say which of them is this task's
        return f"a Dask worker declares {declared:g} GPUs; allowed is one, each with its CUDA_VISIBLE_DEVICES"
    environment = {**os.environ, **import_environment(), **({} if gpus else {VISIBLE: ""})}
    with tempfile.TemporaryDirectory() as folder:
        said = Path(folder, "said")
        line = [sys.executable, "-m", __name__, str(said)]
        with subprocess.Popen(line, stdin=subprocess.PIPE, env=environment) as process:
            assert process.stdin is not None
            pickle.dump(work, process.stdin)
            process.stdin.flush()
            while process.poll() is None:
                if Event(stop).wait(PAUSE):
                    process.kill()
        if process.returncode:
            raise RuntimeError(f"the worker's process ended with {process.returncode}")
        return said.read_text() or None


def _alone(said: Path) -> None:
    """Do the work that is read from the standard input, and write the line that it returns to a file."""
    work: Work = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_end_with_the_input, daemon=True).start()
    said.write_text(work() or "")


def _end_with_the_input() -> None:
    """End this process when the process at the other end of the standard input is gone."""
    while os.read(sys.stdin.fileno(), 1):  # past Python's buffer, which its end waits for
        pass
    os._exit(1)


if __name__ == "__main__":
    _alone(Path(sys.argv[1]))
