"""The controller of a sweep: it starts workers while runs are missing, and shows the progress."""

import time
from pathlib import Path

from memmlp.common.errors import InputError
from memmlp.sweep.executors import Executor, Handle, Work
from memmlp.sweep.plan import Plan
from memmlp.sweep.progress_table import Board

READ_INTERVAL = 0.5  # seconds between two reads of the run folders
MIN_LIFETIME = 20.0  # seconds; a worker that ends sooner has failed to start
MAX_FAILED_STARTS = 5  # the maximum number of failed starts in a row, per worker of the fleet
SUBMIT_PAUSE = 10.0  # seconds after a replacement could not be submitted; a cluster may restart meanwhile


class Fleet:
    """At most `size` workers of a controller, each of which calls `work`. A worker that died is replaced.
    `logs` is the folder of their logs, for error messages."""

    def __init__(self, executor: Executor, work: Work, size: int, logs: Path):
        self.executor, self.work, self.size, self.logs = executor, work, size, logs
        self.handles: list[tuple[Handle, float]] = []  # with the time of the start
        self.failed_starts = 0
        self.complaint: str | None = None
        self.next_start: float | None = None  # None before the first start

    def keep_workers_running(self, count: int) -> None:
        """Start workers until `count` are running; the fleet's size is the maximum. Raises InputError if the
        first workers cannot be started, or too many in a row end soon after their start while no other works.
        """
        now = time.monotonic()
        living = []
        for handle, started in self.handles:
            if handle.alive():
                living.append((handle, started))
                continue
            complaint = handle.complaint()
            self.complaint = complaint or self.complaint
            quick = complaint is not None or now - started < MIN_LIFETIME
            self.failed_starts = self.failed_starts + 1 if quick else 0
        self.handles = living
        working = any(now - started >= MIN_LIFETIME for _, started in living)
        if self.failed_starts >= MAX_FAILED_STARTS * self.size and not working:
            reason = self.complaint or "the reason"
            raise InputError(f"workers end as soon as they are started: {reason}; see {self.logs}")
        missing = min(count, self.size) - len(self.handles)
        if missing > 0 and now >= (self.next_start or 0.0):
            self._start(missing)

    def _start(self, count: int) -> None:
        now = time.monotonic()
        try:
            self.handles += [(handle, now) for handle in self.executor.submit(self.work, count)]
            self.next_start = now
        except InputError as error:
            if self.next_start is None:
                raise
            self.complaint, self.next_start = str(error), now + SUBMIT_PAUSE
            self.failed_starts += count

    def cancel(self) -> None:
        for handle, _ in self.handles:
            if handle.alive():
                handle.cancel()


def complete_plan(plan: Plan, fleet: Fleet, board: Board) -> None:
    """Keep the fleet working on the plan until all its tasks are done, also those that other sweeps' workers
    do. If this process is interrupted, it ends its workers. Finished runs are read again only when no task
    seems to remain, because a sweep may have many runs."""
    try:
        with board:
            board.update(plan, states := plan.read_states())
            while tasks := plan.list_remaining(states) or plan.list_remaining(states := plan.read_states()):
                fleet.keep_workers_running(len(tasks))
                time.sleep(READ_INTERVAL)
                board.update(plan, states := plan.read_states(states))
    except BaseException:
        fleet.cancel()
        raise
