"""Where workers run: processes of this machine or jobs of a Slurm cluster by submitit, or Ray's tasks.

An executor only starts workers; which run is whose is settled among them (memmlp.sweep.worker).
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from memmlp.errors import InputError

if TYPE_CHECKING:
    import submitit

FOREVER = 7 * 24 * 60  # minutes: local workers end by themselves


class Handle(Protocol):
    """A started worker."""

    def alive(self) -> bool:
        """Whether it waits or works."""

    def cancel(self) -> None:
        """End it."""


class Executor(Protocol):
    """Starts workers."""

    def submit(self, work: Callable[[], None]) -> Handle:
        """Start a worker; `work` must be importable where it runs."""

    def describe(self) -> str:
        """What would be started, for a look before the start."""


class Requeued:
    """Work that a preempted Slurm job does again: its runs go on from their checkpoints."""

    def __init__(self, work: Callable[[], None]):
        self.work = work

    def __call__(self) -> None:
        """Work."""
        self.work()

    def checkpoint(self) -> Any:
        """What submitit queues when the job is preempted or its time is up."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self)


class Submitted:
    """A submitit job."""

    def __init__(self, job: submitit.Job):
        self.job = job

    def alive(self) -> bool:
        """Whether it waits or works."""
        return not self.job.done()

    def cancel(self) -> None:
        """End it."""
        self.job.cancel(check=False)


class Submitit:
    """submitit's executors: cluster "local" (processes), "slurm", or "debug" (in this process)."""

    def __init__(self, cluster: str, folder: Path, options: Mapping[str, Any] | None = None):
        import submitit

        logging.getLogger("submitit").setLevel(logging.ERROR)
        self.cluster, self.folder = cluster, folder
        try:
            self.executor = submitit.AutoExecutor(folder=str(folder), cluster=cluster)
            self.executor.update_parameters(**{"timeout_min": FOREVER, "name": "memmlp", **(options or {})})
        except (RuntimeError, TypeError, ValueError, AssertionError, NameError) as error:
            raise InputError(f"executor={cluster}: {' '.join(str(error).split())}") from None

    def submit(self, work: Callable[[], None]) -> Submitted:
        """Start a worker."""
        return Submitted(self.executor.submit(Requeued(work)))

    def describe(self) -> str:
        """The sbatch file of a worker, or where local ones leave their logs."""
        inner: Any = self.executor._executor
        if self.cluster != "slurm":
            return f"workers' logs: {self.folder}"
        return inner._make_submission_file_text("memmlp-worker", "")


class RayTask:
    """A Ray task."""

    def __init__(self, reference: Any):
        self.reference = reference

    def alive(self) -> bool:
        """Whether it waits or works."""
        import ray

        return not ray.wait([self.reference], timeout=0)[0]

    def cancel(self) -> None:
        """End it."""
        import ray

        ray.cancel(self.reference, force=True)


class Ray:
    """Tasks of a Ray cluster: the one of RAY_ADDRESS, or one on this machine."""

    def __init__(self, options: Mapping[str, Any] | None = None):
        try:
            import ray
        except ImportError:
            raise InputError("executor=ray: Ray is not installed; pip install 'memmlp[ray]'") from None
        if not ray.is_initialized():
            ray.init(log_to_driver=False, configure_logging=False, include_dashboard=False)
        self.options = {"num_cpus": 1, "max_retries": 0, **(options or {})}

    def submit(self, work: Callable[[], None]) -> RayTask:
        """Start a worker."""
        import ray

        return RayTask(ray.remote(**self.options)(_call).remote(work))

    def describe(self) -> str:
        """Ray's resources for a worker."""
        return f"Ray tasks with {self.options}"


def _call(work: Callable[[], None]) -> None:
    work()
