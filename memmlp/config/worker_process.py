"""A worker's process: for each task of a plan, it builds the experiment and finishes the run."""

from functools import partial
from pathlib import Path

from memmlp.common.errors import InputError
from memmlp.sweep.plan import Plan, RunTask
from memmlp.sweep.worker import Cancelled, has_controller, is_writer_alive, work_on_plan
from memmlp.training.request import RunRequest


def work(path: str, threads: int, controller: str | None, gpu: bool) -> str | None:
    """Perform the tasks of the plan in a file. `threads` is the number of torch's threads if the config does
    not set it; 0 for torch's default. `controller` is the file that shows whether the controller is alive
    (`write_process_file`); the worker ends with it. A worker without it, on another machine, finishes a
    closed plan, and leaves an open plan when the controller no longer touches the plan's file. If a worker
    needs a `gpu` and finds no GPU, it does nothing and returns a line that says why; otherwise return None.
    """
    if gpu:
        from memmlp.training import devices  # it imports torch

        if line := devices.describe_missing_gpu():
            return line
    alive, file = (is_writer_alive, controller) if controller else (has_controller, path)
    work_on_plan(Path(path), partial(perform_task, Path(path), threads), partial(alive, Path(file)))
    return None


def perform_task(path: Path, threads: int, plan: Plan, task: RunTask) -> None:
    """Finish a task's run; `threads` as in `work`. The plan's file is read repeatedly. Raises Cancelled if it
    cancels the run, and InputError if the data or the code has changed since the plan was made."""
    from omegaconf import OmegaConf

    from memmlp.common.text_formats import escape_interpolations
    from memmlp.config.build import build_experiment
    from memmlp.config.plugins import activate
    from memmlp.runs.identity import NETWORK
    from memmlp.training.devices import use_threads
    from memmlp.training.run_stages import make_prerequisites, run_experiment

    activate(task.config.get("plugins") or ())
    experiment = build_experiment(OmegaConf.create(escape_interpolations(task.config)))
    check_identity(experiment, task)
    use_threads(experiment.config["threads"] or threads)
    if task.kind != NETWORK:
        make_prerequisites(experiment, experiment.motion.prepare(), task.id)
    else:
        run_experiment(experiment, partial(check_not_cancelled, path, task.id))


def check_identity(request: RunRequest, task: RunTask) -> None:
    """Prepare the data. Raise InputError if the request no longer has the task's run."""
    from memmlp.config.compose_plan import make_tasks

    tasks = make_tasks(request, request.motion.prepare().digest)
    if task.key not in {key for one in tasks for key in (one.id, one.key)}:
        raise InputError(f"run {task.id}: the data or the code has changed; start the sweep again")


def check_not_cancelled(path: Path, run_id: str, step: int, values: dict[str, float]) -> None:
    """Raise Cancelled if the plan in a file cancels the run."""
    plan = Plan.load(path)
    if run_id in plan.cancelled:
        raise Cancelled(f"run {run_id} was cancelled at step {step}")
