"""The controller of a sweep: keeps workers going while there is work, and shows how far it is."""

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
QUICK = 20.0  # seconds within which a worker that ends has not begun to work
PATIENCE = 5  # workers in a row that may end so


class Fleet:
    """As many workers as there is work for; those that died are replaced.

    Args:
        executor: starts them. work: what a worker does. size: how many at most. logs: where theirs are.
        presence: what tells the workers that the controller lives; it ends with the fleet.
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
        """Bring the number of living workers to `wanted`, or to the fleet's size.

        Raises InputError when one after another ends as soon as it is started.
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
    """Keep the fleet at the plan until nothing is left; when stopped or interrupted, end the workers.

    Runs that other sweeps' workers are at are waited for.
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
