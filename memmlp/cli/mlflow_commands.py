"""`memmlp track` and `memmlp ui`: run folders shown in MLflow."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import click

from memmlp.cli.options import outputs_option
from memmlp.common.errors import InputError


@click.group("track")
def track() -> None:
    """Show run folders in MLflow."""


@track.command("sync")
@click.option(
    "--uri",
    default=None,
    help="Address of MLflow's store.  [default: MLFLOW_TRACKING_URI, or else sqlite in OUTPUTS]",
)
@outputs_option
def sync(uri: str | None, outputs: Path) -> None:
    """Bring MLflow up to date with all runs.

    All finished runs and sweeps are shown in its store. It may be repeated at any time.
    """
    from memmlp.common.progress import progress_bar
    from memmlp.runs.lookup import list_runs
    from memmlp.runs.mlflow_tracking import MLflowTracking
    from memmlp.sweep.plan import Plan

    tracking = MLflowTracking(uri, outputs)
    finished = [run for run in list_runs(outputs) if run.done]
    for run in progress_bar(finished, "runs"):
        tracking.project(run)
    known = {run.id for run in finished}
    plans = [Plan.load(path) for path in sorted(outputs.glob("sweeps/*/plan.json"))]
    for plan in plans:
        tracking.group(plan.name, {e.id: e.label for e in plan.entries if e.id in known})
    click.echo(f"{len(finished)} runs and {len(plans)} sweeps are in {tracking.store()}")


@click.command("ui")
@click.option("--port", default=5000, show_default=True)
@outputs_option
def ui(port: int, outputs: Path) -> None:
    """Open MLflow's page on the tracked runs (needs pip install 'memmlp[ui]')."""
    from memmlp.runs.mlflow_tracking import MLflowTracking

    store = MLflowTracking(None, outputs).store()
    program = shutil.which("mlflow")
    try:
        import mlflow.server  # noqa: F401  (mlflow-skinny has none)
    except ImportError:
        program = None
    if program is None:
        raise InputError("ui: MLflow's page is not installed; pip install 'memmlp[ui]'")
    os.execv(program, [program, "ui", "--backend-store-uri", store, "--port", str(port)])
