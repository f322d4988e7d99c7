"""Executors, which start workers: as processes, as jobs of a Slurm cluster, or as tasks of Ray.

Processes and Slurm jobs are submitit's. An executor only starts workers; which worker does which run is
settled among them (memmlp.sweep.worker).
"""

from __future__ import annotations

import contextlib
import logging
import signal
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from memmlp.common.errors import InputError

if TYPE_CHECKING:
    import submitit

FOREVER = 7 * 24 * 60  # minutes, a limit that submitit wants; workers end by themselves


class Handle(Protocol):
    """A worker that was started."""

    def alive(self) -> bool:
        """Return whether the worker waits or works."""

    def cancel(self) -> None:
        """End the worker."""


class Executor(Protocol):
    """Starts workers."""

    def submit(self, work: Callable[[], None]) -> Handle:
        """Start a worker; `work` must be picklable, and importable where the worker runs."""


class Requeued:
    """Work that a preempted Slurm job does again; its runs go on from their checkpoints."""

    def __init__(self, work: Callable[[], None]):
        self.work = work

    def __call__(self) -> None:
        """Do the work."""
        self.work()

    def checkpoint(self) -> Any:
        """Return what submitit puts into the queue when the job is preempted or its time is up."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self)


class Submitted:
    """A worker that is a job of submitit's."""

    def __init__(self, job: submitit.Job):
        self.job = job

    def alive(self) -> bool:
        """Return whether the job waits or works."""
        return not self.job.done()

    def cancel(self) -> None:
        """End the job."""
        self.job.cancel(check=False)


class Submitit:
    """Starts workers by submitit.

    Args:
        cluster: "local" (processes of this machine), "slurm", or "debug" (inside this process).
        folder: the folder of the workers' logs, with %j for a worker's number.
        options: submitit's parameters, those of sbatch among them.

    Raises:
        InputError: where submitit refuses the cluster or an option.
    """

    def __init__(self, cluster: str, folder: Path, options: Mapping[str, Any] | None = None):
        import submitit

        logging.getLogger("submitit").setLevel(logging.ERROR)
        kinds: dict[str, type[submitit.Executor]] = {
            "local": submitit.LocalExecutor,
            "slurm": submitit.SlurmExecutor,
            "debug": submitit.DebugExecutor,
        }
        try:
            self.executor = kinds[cluster](folder=folder)
            _set(self.executor, options)
        except (RuntimeError, TypeError, ValueError, NameError) as error:
            raise InputError(f"executor={cluster}: {' '.join(str(error).split())}") from None

    def submit(self, work: Callable[[], None]) -> Submitted:
        """Start a worker."""
        with _interruptible():
            return Submitted(self.executor.submit(Requeued(work)))


@contextlib.contextmanager
def _interruptible() -> Iterator[None]:
    """Processes started herein hear SIGINT, by which submitit cancels, where this one ignores it (nohup)."""
    before = signal.getsignal(signal.SIGINT)
    if before is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        yield
    finally:
        if before is signal.SIG_IGN:
            signal.signal(signal.SIGINT, signal.SIG_IGN)


def sbatch(folder: Path, options: Mapping[str, Any] | None = None) -> str:
    """Return the file that sbatch would be given for a worker; Slurm need not be installed."""
    import submitit

    class Anywhere(submitit.SlurmExecutor):
        @classmethod
        def affinity(cls) -> int:
            return 1

    executor = Anywhere(folder=folder)
    _set(executor, options)
    return executor._make_submission_file_text(executor._submitit_command_str, "worker")


def _set(executor: submitit.Executor, options: Mapping[str, Any] | None) -> None:
    """Give the executor its options under the names by which it knows them."""
    common = {"name": "memmlp", "timeout_min": FOREVER, **(options or {})}
    executor.update_parameters(**executor._convert_parameters(common))


class RayTask:
    """A worker that is a task of Ray's."""

    def __init__(self, reference: Any):
        self.reference = reference

    def alive(self) -> bool:
        """Return whether the task waits or works."""
        import ray

        return not ray.wait([self.reference], timeout=0)[0]

    def cancel(self) -> None:
        """End the task."""
        import ray

        ray.cancel(self.reference, force=True)


class Ray:
    """Starts workers as tasks of a Ray cluster: the one that RAY_ADDRESS names, or one on this machine.

    Raises:
        InputError: where Ray is not installed.
    """

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


def _call(work: Callable[[], None]) -> None:
    work()
