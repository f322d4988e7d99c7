"""A worker takes a plan's tasks, one after another, each under its run's lease, until none is left.

Any number of workers, on any machines that share the outputs folder, may work on the same runs. A run is
finished by one of them. When a worker is killed, or stands still for longer than its lease, another worker
takes over its run from the last checkpoint. What a worker does with a task is in `config/worker_process.py`.
"""

from __future__ import annotations

import sys
import time
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path

from memmlp.common.errors import InputError, LeaseLost, TrainingDiverged, is_disk_error
from memmlp.common.files import read_json, write_json
from memmlp.common.lease import ChangeTimer, current_process, is_alive
from memmlp.runs.run import Run
from memmlp.sweep.plan import Plan, RunTask

PAUSE = 0.5  # seconds between two looks at a plan while other workers do its tasks
ABANDONED = 600.0  # seconds without a sign of life after which an open plan's controller counts as dead
DEATHS = 10  # workers that died at the same step of a run before it counts as failed

_changes = ChangeTimer()

Perform = Callable[[Plan, RunTask], None]


class Cancelled(Exception):
    """Raised when the plan no longer wants the run; its folder stays as it is, and can be resumed."""


def work_off(path: Path, perform: Perform, wanted: Callable[[], bool] = lambda: True) -> None:
    """Work on the plan in a file while `wanted` returns true and tasks are left.

    The file is read again before each task, since the plan may have changed. An open plan (a search's) may
    get more tasks, so its workers stay.

    Args:
        path: the plan's file.
        perform: brings a task's run to its end, or raises.
        wanted: whether to go on.
    """
    states: Mapping[str, str] = {}
    while wanted():
        plan = Plan.load(path)
        left = plan.left(states := plan.states(states))
        if not left and not plan.open:
            return
        if not any(attempt(plan, task, perform) for task in left):
            time.sleep(PAUSE)


def has_controller(path: Path) -> bool:
    """Return whether the plan in a file is closed, or is open and has a living controller.

    A living controller touches the file repeatedly. The time for which this process has seen the file
    untouched decides, since the controller's machine may have another clock.
    """
    if not Plan.load(path).open:
        return True
    return _changes.seconds_unchanged(path, lambda: path.stat().st_mtime_ns) < ABANDONED


def attempt(plan: Plan, task: RunTask, perform: Perform) -> bool:
    """Finish a task's run, if its prerequisite is done and no other process works on it.

    A failure is recorded with the run, and does not affect the other tasks.

    Returns:
        False if the task has to wait for its prerequisite or for another worker; else True.

    Raises:
        OSError: if the disk is full or read-only, which affects every task.
    """
    run = plan.run_of(task)
    if task.prerequisite and not Run.from_id(plan.outputs, task.prerequisite).done:
        return False
    with run.lock(wait=False) as mine:
        if not mine:
            return False
        try:
            if not plan.complete(task) and not run.failure:  # unless another process has ended it
                _perform(plan, task, run, perform)
        except LeaseLost as lost:
            print(f"memmlp: {lost}", file=sys.stderr, flush=True)
    return True


def _perform(plan: Plan, task: RunTask, run: Run, perform: Perform) -> None:
    if count_deaths(run) >= DEATHS:
        run.fail(f"{DEATHS} processes died at step {run.step} of it, one after another")
        return
    try:
        perform(plan, task)
    except Cancelled:
        pass
    except LeaseLost:
        raise
    except (InputError, TrainingDiverged) as error:
        run.fail(str(error))
    except Exception as error:
        if is_disk_error(error):
            raise
        run.fail(f"{type(error).__name__}: {error}", traceback.format_exc())


def count_deaths(run: Run) -> int:
    """Count how many processes, one after another, most recently started the run at its present step.

    Those before work that ended well, or before the last --retry, don't count.
    """
    step, count, manifest = run.step, 0, run.manifest
    for start in reversed(manifest.get("attempts", [])[manifest.get("forgiven", 0) :]):
        if start.get("step") != step:
            break
        count += 1
    return count


class Presence:
    """A sign that the process which made it is alive: a file that names the process and its machine."""

    def __init__(self, path: Path):
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path = path
        write_json(path, current_process())

    @staticmethod
    def of(path: Path) -> bool:
        """Return whether the process that made the file is alive, or may be alive on another machine."""
        process = read_json(path)
        return bool(process) and is_alive(process) is not False
