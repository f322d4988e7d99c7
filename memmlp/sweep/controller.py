"""The controller of a sweep: it keeps workers going while there is work, and shows how far it is."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from memmlp.common.errors import InputError
from memmlp.sweep.board import Board
from memmlp.sweep.executors import Executor, Handle
from memmlp.sweep.plan import Plan
from memmlp.sweep.worker import Presence

LOOK = 0.5  # seconds between looks at the run folders
QUICK = 20.0  # seconds; a worker that ends sooner has failed to start
PATIENCE = 5  # how many in a row, times the fleet's size, may fail to start


class Fleet:
    """The workers of a controller: as many as there is work for, those that died replaced.

    Args:
        executor: starts workers.
        work: what a worker does.
        size: the largest number of workers.
        logs: the folder of the workers' logs, for error messages.
        presence: tells the workers that the controller lives, for as long as the fleet exists.
    """

    def __init__(
        self,
        executor: Executor,
        work: Callable[[], None],
        size: int,
        logs: Path,
        presence: Presence | None = None,
    ):
        self.executor, self.work, self.size, self.logs = executor, work, size, logs
        self.presence = presence
        self.handles: list[tuple[Handle, float]] = []
        self.stillborn = 0

    def keep(self, wanted: int) -> None:
        """Start workers until `wanted` are alive, or as many as the fleet's size.

        Raises:
            InputError: when workers one after another end as soon as they are started.
        """
        ended = [started for handle, started in self.handles if not handle.alive()]
        self.handles = [(handle, started) for handle, started in self.handles if handle.alive()]
        now = time.monotonic()
        for started in ended:
            self.stillborn = self.stillborn + 1 if now - started < QUICK else 0
        if self.stillborn >= PATIENCE * self.size:
            raise InputError(f"workers end as soon as they are started; the reason is in {self.logs}")
        for _ in range(min(wanted, self.size) - len(self.handles)):
            self.handles.append((self.executor.submit(self.work), now))

    def cancel(self) -> None:
        """End all workers."""
        for handle, _ in self.handles:
            if handle.alive():
                handle.cancel()


def oversee(plan: Plan, fleet: Fleet, board: Board) -> None:
    """Keep the fleet at the plan until nothing is left.

    Runs that the workers of other sweeps are at are waited for. When the plan is stopped by a failure, or
    this process is interrupted, the workers are ended.
    """
    try:
        with board:
            board.update(plan)
            while left := plan.left():
                fleet.keep(len(left))
                time.sleep(LOOK)
                board.update(plan)
        if plan.stopped:
            fleet.cancel()
    except BaseException:
        fleet.cancel()
        raise
