"""The controller of a sweep: it keeps workers going while there is work, and shows the progress."""

from __future__ import annotations

import time
from pathlib import Path

from memmlp.common.errors import InputError
from memmlp.sweep.executors import Executor, Handle, Work
from memmlp.sweep.plan import Plan
from memmlp.sweep.progress_table import Board
from memmlp.sweep.worker import Presence

LOOK = 0.5  # seconds between looks at the run folders
QUICK = 20.0  # seconds; a worker that ends sooner has failed to start
PATIENCE = 5  # how many in a row, times the fleet's size, may fail to start


class Fleet:
    """The workers of a controller: as many as there is work for; workers that died are replaced.

    Args:
        executor: starts workers.
        work: what a worker does.
        size: the largest number of workers.
        logs: the folder of the workers' logs, for error messages.
        presence: shows the workers that the controller is alive, for as long as the fleet exists.
    """

    def __init__(
        self,
        executor: Executor,
        work: Work,
        size: int,
        logs: Path,
        presence: Presence | None = None,
    ):
        self.executor, self.work, self.size, self.logs = executor, work, size, logs
        self.presence = presence
        self.handles: list[tuple[Handle, float]] = []
        self.failed_starts = 0
        self.complaint: str | None = None

    def keep(self, wanted: int) -> None:
        """Start workers until `wanted` of them are alive, but no more than the fleet's size.

        Raises:
            InputError: if workers, one after another, end as soon as they are started.
        """
        now = time.monotonic()
        living = []
        for handle, started in self.handles:
            if handle.alive():
                living.append((handle, started))
                continue
            complaint = handle.complaint()
            self.complaint = complaint or self.complaint
            quick = complaint is not None or now - started < QUICK
            self.failed_starts = self.failed_starts + 1 if quick else 0
        self.handles = living
        if self.failed_starts >= PATIENCE * self.size:
            reason = self.complaint or "the reason"
            raise InputError(f"workers end as soon as they are started: {reason}; see {self.logs}")
        if (missing := min(wanted, self.size) - len(self.handles)) > 0:
            self.handles += [(handle, now) for handle in self.executor.submit(self.work, missing)]

    def cancel(self) -> None:
        """End all workers."""
        for handle, _ in self.handles:
            if handle.alive():
                handle.cancel()


def oversee(plan: Plan, fleet: Fleet, board: Board) -> None:
    """Keep the fleet working on the plan until nothing is left.

    It waits for runs on which workers of other sweeps are working. If this process is interrupted, the
    workers are ended.

    Runs that are done are looked at again only when nothing seems left: a sweep may have many, on a disk that
    others use, too.
    """
    try:
        with board:
            board.update(plan, states := plan.states())
            while left := plan.left(states) or plan.left(states := plan.states()):
                fleet.keep(len(left))
                time.sleep(LOOK)
                board.update(plan, states := plan.states(states))
    except BaseException:
        fleet.cancel()
        raise
