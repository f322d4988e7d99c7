"""A worker takes a plan's tasks, one after another, each under its run's lock, until none is left.

Any number of workers, on any machines that share the outputs folder, may work on the same runs: a run is
brought to its end by one of them, and a killed one's is taken over from its last checkpoint.
"""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable
from pathlib import Path

from filelock import FileLock, Timeout

from memmlp.common.errors import InputError, TrainingDiverged
from memmlp.runs.run import Run
from memmlp.sweep.plan import Plan, RunTask

PAUSE = 0.5  # seconds between looks at a plan whose tasks are all in other hands
ABANDONED = 600.0  # seconds without a sign of life after which an open plan's controller counts as dead
DEATHS = 10  # workers that died at the same step of a run before it counts as failed

Perform = Callable[[Plan, RunTask], None]


class Cancelled(Exception):
    """The plan no longer wants the run; its folder stays as it is and can be resumed."""


def work(path: Path, perform: Perform, wanted: Callable[[], bool] = lambda: True) -> None:
    """Work on the plan of that file, which is read again before each task, while work is wanted.

    `perform` brings a task's run to its end, or raises.
    """
    while wanted():
        plan = Plan.load(path)
        left = plan.left()
        if not left and not plan.open:
            return
        if not any(attempt(plan, task, perform) for task in left):
            time.sleep(PAUSE)


def directed(path: Path) -> bool:
    """Whether the plan of that file is closed, or its controller, which touches the file, lives."""
    return not Plan.load(path).open or time.time() - path.stat().st_mtime < ABANDONED


def attempt(plan: Plan, task: RunTask, perform: Perform) -> bool:
    """Bring a task's run to its end, if nobody else is at it and its upstream run is done."""
    run = plan.run_of(task)
    if task.upstream and not Run.of(plan.outputs, task.upstream).done:
        return False
    with run.lock(wait=False) as mine:
        if not mine:
            return False
        if plan.complete(task) or run.failure:
            return True  # somebody else ended it since the plan was looked at
        if deaths(run) >= DEATHS:
            run.fail(f"{DEATHS} processes died at step {run.step} of it, one after another")
            return True
        _perform(plan, task, run, perform)
    return True


def _perform(plan: Plan, task: RunTask, run: Run, perform: Perform) -> None:
    """Perform the task; what goes wrong is left with the run, for the other tasks have no part in it."""
    try:
        perform(plan, task)
    except Cancelled:
        pass
    except (InputError, TrainingDiverged) as error:
        run.fail(str(error))
    except Exception as error:
        run.fail(f"{type(error).__name__}: {error}", traceback.format_exc())


def deaths(run: Run) -> int:
    """How many processes in a row, since a retry, began the run at the step where it still is."""
    step, count, manifest = run.step, 0, run.manifest
    for begun in reversed(manifest.get("attempts", [])[manifest.get("forgiven", 0) :]):
        if begun.get("step") != step:
            break
        count += 1
    return count


class Presence:
    """Says whether the process that made it lives: it holds a lock that its death frees."""

    def __init__(self, path: Path):
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path = path
        self._lock = FileLock(path)
        self._lock.acquire()

    @staticmethod
    def of(path: Path) -> bool:
        """Whether the process with that file lives."""
        probe = FileLock(path)
        try:
            probe.acquire(timeout=0)
        except Timeout:
            return True
        probe.release()
        return False
