"""Workers that submitit starts: the common part of its processes and its Slurm jobs."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from memmlp.common.errors import InputError
from memmlp.common.processes import collect_garbage_rarely
from memmlp.sweep.executors.executor import Work

if TYPE_CHECKING:
    import submitit

UNLIMITED = 365 * 24 * 60  # minutes, where submitit wants a limit and there is none


class Requeued:
    """Work that a preempted Slurm job does again; its runs continue from their checkpoints."""

    def __init__(self, work: Work):
        self.work = work

    def __call__(self) -> str | None:
        """Do the work, in the process that submitit started for it."""
        collect_garbage_rarely()
        return self.work()

    def checkpoint(self) -> Any:
        """Return the submission that submitit queues when the job is preempted or its time is up."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self)


class Submitted:
    """A worker that is a job of submitit."""

    def __init__(self, job: submitit.Job):
        self.job = job

    def alive(self) -> bool:
        """Return whether the job is waiting or working."""
        return not self.job.done()

    def cancel(self) -> None:
        """End the job."""
        self.job.cancel(check=False)

    def complaint(self) -> str | None:
        """Return the worker's own line about why it could do no work; None after any other end."""
        if not self.job.paths.result_pickle.exists() or self.job.exception() is not None:
            return None
        return self.job.result()


@contextlib.contextmanager
def explained(name: str) -> Iterator[None]:
    """Turn errors of submitit into an InputError of one line about executor=NAME."""
    logging.getLogger("submitit").setLevel(logging.ERROR)
    try:
        yield
    except (RuntimeError, TypeError, ValueError, NameError) as error:
        raise InputError(f"executor={name}: {' '.join(str(error).split())}") from None
