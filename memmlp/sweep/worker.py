"""A worker performs a plan's tasks, one after another, each under its run's lease, until no task remains.

Several workers, also on several machines that share the outputs folder, may work on the same plan. Only one
worker at a time works on a run. If a worker is killed, or hangs for longer than its lease, another worker
continues the run from the last checkpoint. `config/worker_process.py` performs a single task.
"""

import itertools
import sys
import time
import traceback
from collections.abc import Callable, Mapping
from pathlib import Path

from memmlp.common.errors import (
    InputError,
    LeaseLost,
    RunStopped,
    TrainingDiverged,
    is_disk_error,
    is_interruption,
)
from memmlp.common.files import read_json, write_json
from memmlp.common.lease import ChangeTimer, current_process, is_alive
from memmlp.runs.run import Run
from memmlp.sweep.plan import Plan, RunTask

PAUSE = 0.5  # seconds between two reads of a plan while other workers perform its tasks
ABANDONED = 600.0  # seconds without a change of an open plan's file before its controller counts as dead
MAX_DEATHS = 10  # number of workers that may die at the same step before the run counts as failed

_changes = ChangeTimer()

Perform = Callable[[Plan, RunTask], None]


class Cancelled(Exception):
    """Raised when the plan cancels a run. The run's folder is kept, so the run can be resumed."""


def work_on_plan(path: Path, perform: Perform, should_continue: Callable[[], bool] = lambda: True) -> None:
    """Perform the tasks of the plan in a file until no task remains, or `should_continue`, called before each
    task, returns False. The file is read again before each task, because the plan may have changed. An open
    plan may get more tasks, so its workers wait for them. `perform` finishes a task's run, or raises an
    exception."""
    states: Mapping[str, str] = {}
    while should_continue():
        plan = Plan.load(path)
        left = plan.list_remaining(states := plan.read_states(states))
        if not left and not plan.open:
            return
        if not any(try_task(plan, task, perform) for task in left):
            time.sleep(PAUSE)


def has_controller(path: Path) -> bool:
    """Return whether a plan is closed, or is open and its controller is alive. A living controller touches
    the plan's file repeatedly. The interval since the last change is measured with this process' clock,
    because the clock of the controller's machine may differ."""
    if not Plan.load(path).open:
        return True
    return _changes.seconds_unchanged(path, lambda: path.stat().st_mtime_ns) < ABANDONED


def try_task(plan: Plan, task: RunTask, perform: Perform) -> bool:
    """Finish a task's run unless its prerequisite or another process blocks it; return whether it was free.
    A failure is recorded in the run's folder, and does not affect other tasks. Raises OSError if the disk is
    full or read-only, which affects every task."""
    run = plan.get_run(task)
    if task.prerequisite and not Run.from_id(plan.outputs, task.prerequisite).done:
        return False
    with run.lock(wait=False) as mine:
        if not mine:
            return False
        try:
            ended = run.failure or run.is_stop_requested  # meanwhile, by another process
            if not ended and not plan.is_complete(task):
                _finish_run(plan, task, run, perform)
        except LeaseLost as lost:
            print(f"memmlp: {lost}", file=sys.stderr, flush=True)
    return True


def _finish_run(plan: Plan, task: RunTask, run: Run, perform: Perform) -> None:
    if count_deaths(run) >= MAX_DEATHS:
        run.fail(f"{MAX_DEATHS} processes in a row died at step {run.step}")
        return
    try:
        perform(plan, task)
    except Cancelled:
        pass
    except RunStopped:
        run.reset_deaths()
    except (LeaseLost, BrokenPipeError):  # whoever read the worker's output has died
        raise
    except (KeyboardInterrupt, Exception) as error:
        if is_interruption(error):
            run.reset_deaths()  # a scheduler may interrupt a run any number of times
            raise KeyboardInterrupt from error
        if is_disk_error(error):
            raise
        if isinstance(error, InputError | TrainingDiverged):
            run.fail(str(error))
        else:
            run.fail(f"{type(error).__name__}: {error}", traceback.format_exc())


def count_deaths(run: Run) -> int:
    """Count the latest processes in a row that started the same stage of the run at its current step, since
    the last successful work, interruption or --retry."""
    manifest = run.manifest
    starts = manifest.get("attempts", [])[manifest.get("forgiven", 0) :]
    last = (run.step, starts[-1].get("stage") if starts else None)
    same = itertools.takewhile(lambda one: (one.get("step"), one.get("stage")) == last, reversed(starts))
    return sum(1 for _ in same)


def write_process_file(path: Path) -> None:
    """Write a file with this process and its machine, from which others see whether the process is alive."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, current_process())


def is_writer_alive(path: Path) -> bool:
    """Return whether the process that wrote the file is alive, or may be alive on another machine."""
    process = read_json(path)
    return bool(process) and is_alive(process) is not False
