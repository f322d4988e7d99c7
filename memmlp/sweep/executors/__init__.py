"""Executors start workers: processes, jobs of a Slurm cluster, or tasks of Ray or Dask.

The workers settle among themselves which of them does which run (`memmlp.sweep.worker`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

Work = Callable[[], str | None]
"""A worker's work. It returns None at its end, or a line that says why this worker could do no work."""


class Handle(Protocol):
    """A worker that an executor started."""

    def alive(self) -> bool:
        """Return whether the worker is waiting or working."""

    def cancel(self) -> None:
        """End the worker."""

    def complaint(self) -> str | None:
        """Return the worker's own line about why it could do no work; None after any other end."""


class Executor(Protocol):
    """Starts workers.

    Attributes:
        gpus: whether each worker gets a GPU.
    """

    gpus: bool

    def submit(self, work: Work, count: int = 1) -> Sequence[Handle]:
        """Start `count` workers; `work` must be picklable, and importable on the workers' machines."""
