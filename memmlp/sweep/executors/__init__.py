"""Executors start workers: processes, or jobs of a Slurm cluster. Each worker chooses its runs itself."""

from collections.abc import Callable, Sequence
from typing import Protocol

Work = Callable[[], str | None]
"""The function that a worker calls. It returns None, or a line that explains why it could not work."""


class Handle(Protocol):
    """A worker that an executor started."""

    def alive(self) -> bool:
        """Return whether the worker is waiting or working."""

    def cancel(self) -> None:
        """End the worker."""

    def complaint(self) -> str | None:
        """Return the line that explains why the worker could not work; None after any other end."""


class Executor(Protocol):
    """Starts workers."""

    gpus: bool  # whether each worker gets a GPU

    def submit(self, work: Work, count: int = 1) -> Sequence[Handle]:
        """Start `count` workers. `work` must be picklable, and importable on the workers' machines."""
