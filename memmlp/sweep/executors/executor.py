"""What every executor and the worker that it started can do."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

Work = Callable[[], str | None]
"""What a worker does. It returns None at its end, or a line that says why this worker could do nothing."""


class Handle(Protocol):
    """A worker that was started."""

    def alive(self) -> bool:
        """Return whether the worker waits or works."""

    def cancel(self) -> None:
        """End the worker."""

    def complaint(self) -> str | None:
        """Return the line with which a worker ended that could do nothing; None for any other end."""


class Executor(Protocol):
    """Starts workers.

    Attributes:
        gpus: whether each worker is to have a GPU.
    """

    gpus: bool

    def submit(self, work: Work, count: int = 1) -> Sequence[Handle]:
        """Start `count` workers; `work` must be picklable, and importable where the workers run."""
