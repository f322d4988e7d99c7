"""The tracking slot: shows run folders in MLflow, from which they can be shown again at any time."""

from __future__ import annotations

import contextlib
import logging
import os
import sys
import warnings
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from filelock import FileLock

from memmlp.runs.identity import flatten
from memmlp.runs.run import Run

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Metric

QUIET = {
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "DO_NOT_TRACK": "true",
    "GIT_PYTHON_REFRESH": "quiet",
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1",  # an unreachable server must not hold up a run
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "10",
}
CHATTY = ("mlflow", "alembic", "urllib3")


class Tracking(Protocol):
    """The slot's interface: shows runs elsewhere."""

    def project(self, run: Run) -> None:
        """Show the run as its folder is now; a second call changes nothing."""

    def group(self, sweep: str, labels: Mapping[str, str]) -> None:
        """Show runs as those of a sweep; `labels` maps their ids to their arms' labels."""


class NoTracking:
    """Tracking that shows nothing."""

    def project(self, run: Run) -> None:
        """Do nothing."""

    def group(self, sweep: str, labels: Mapping[str, str]) -> None:
        """Do nothing."""


class MLflowTracking:
    """Tracking by MLflow: one MLflow run for each run folder, found again by its tag `memmlp.run_id`.

    Args:
        uri: the tracking store; None for MLFLOW_TRACKING_URI, or else a sqlite file in the outputs folder.
        outputs: the outputs folder.
    """

    EXPERIMENT = "memmlp"
    ARTIFACTS = ("config.yaml", "results.json", "poses.png")
    PARAM_LENGTH = 6000  # MLflow's limits
    PARAMS, METRICS = 100, 1000

    def __init__(self, uri: str | None, outputs: Path | str):
        self.uri, self.outputs = uri, Path(outputs).absolute()

    def project(self, run: Run) -> None:
        """Create the MLflow run, or bring it up to date."""
        self.outputs.mkdir(parents=True, exist_ok=True)
        # Two processes that create a sqlite store at the same time ruin it.
        lock = FileLock(self.outputs / ".mlflow.lock")
        with _quiet(), lock:
            from mlflow import MlflowClient

            client = MlflowClient(tracking_uri=self.store())
            name = self._mlflow_run(client, self._experiment(client), run)
            self._params(client, name, run)
            self._metrics(client, name, run)
            files = [
                *(run.folder / artifact for artifact in self.ARTIFACTS),
                run.onnx,
                run.preferred_deployment.latency,
            ]
            for path in filter(Path.is_file, files):
                client.log_artifact(name, str(path))
            if run.done:
                client.set_terminated(name, "FINISHED", _milliseconds(run.manifest["finished"]))

    def group(self, sweep: str, labels: Mapping[str, str]) -> None:
        """Make a sweep the parent of its runs.

        A run that several sweeps share stays a child of the first one; a tag for each sweep holds its label
        there.

        Args:
            sweep: the sweep's name.
            labels: run id -> the arm's label, of runs that were projected.
        """
        with _quiet(), FileLock(self.outputs / ".mlflow.lock"):
            from mlflow import MlflowClient

            client = MlflowClient(tracking_uri=self.store())
            experiment = self._experiment(client)
            parents = client.search_runs([experiment], f"tags.`memmlp.sweep` = '{sweep}'")
            parent = parents[0] if parents else None
            if parent is None:
                parent = client.create_run(experiment, tags={"memmlp.sweep": sweep}, run_name=sweep)
            for run_id, label in labels.items():
                for child in client.search_runs([experiment], f"tags.`memmlp.run_id` = '{run_id}'"):
                    client.set_tag(child.info.run_id, f"memmlp.arm.{sweep}", label)
                    if "mlflow.parentRunId" not in child.data.tags:
                        client.set_tag(child.info.run_id, "mlflow.parentRunId", parent.info.run_id)
            client.set_terminated(parent.info.run_id, "FINISHED")

    def store(self) -> str:
        """Return the URI of the store in which MLflow keeps its runs."""
        return self.uri or os.environ.get("MLFLOW_TRACKING_URI") or f"sqlite:///{self.outputs / 'mlflow.db'}"

    def _experiment(self, client: MlflowClient) -> str:
        """Return the id of MLflow's experiment, which is created if it is missing."""
        experiment = client.get_experiment_by_name(self.EXPERIMENT)
        if experiment is not None:
            return experiment.experiment_id
        local = self.store().startswith("sqlite:")
        place = (self.outputs / "mlflow-artifacts").as_uri() if local else None
        return client.create_experiment(self.EXPERIMENT, artifact_location=place)

    def _mlflow_run(self, client: MlflowClient, experiment: str, run: Run) -> str:
        """Return the id of the MLflow run; one of an earlier start of the same run is replaced."""
        tags = _tags(run)
        for old in client.search_runs([experiment], f"tags.`memmlp.run_id` = '{run.id}'"):
            if old.data.tags.get("memmlp.started") == tags["memmlp.started"]:
                return old.info.run_id
            client.delete_run(old.info.run_id)
        start = _milliseconds(tags["memmlp.started"])
        return client.create_run(experiment, start, tags, run_name=run.id).info.run_id

    def _params(self, client: MlflowClient, name: str, run: Run) -> None:
        """Log the flattened config, except what MLflow has already, since it allows no changes."""
        from mlflow.entities import Param

        known = client.get_run(name).data.params
        config = {key: str(value)[: self.PARAM_LENGTH] for key, value in flatten(run.config).items()}
        new = [Param(key, value) for key, value in config.items() if key not in known]
        for part in _chunks(new, self.PARAMS):
            client.log_batch(name, params=part)

    def _metrics(self, client: MlflowClient, name: str, run: Run) -> None:
        """Log the values that MLflow does not have yet, in batches."""
        known: set[tuple[str, int]] = set()
        for key in client.get_run(name).data.metrics:
            known |= {(key, metric.step) for metric in client.get_metric_history(name, key)}
        new = [metric for metric in _all_metrics(run) if (metric.key, metric.step) not in known]
        for part in _chunks(new, self.METRICS):
            client.log_batch(name, metrics=part)


def project_safely(tracking: Tracking, run: Run) -> None:
    """Project a run; a failure is only a line on stderr, since the run's folder has everything."""
    with harmless(f"run {run.id}"):
        tracking.project(run)


@contextlib.contextmanager
def harmless(what: str) -> Iterator[None]:
    """Turn a failure of the tracking into a warning of one line."""
    try:
        yield
    except Exception as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        print(f"memmlp: warning: {what} is not shown by the tracking: {reason}", file=sys.stderr)


def _tags(run: Run) -> dict[str, str]:
    manifest = run.manifest
    tags = {f"memmlp.{key}": manifest.get(key) for key in ("kind", "data", "upstream", "started", "version")}
    tags |= {"memmlp.run_id": run.id, "memmlp.folder": str(run.folder.absolute())}
    tags["mlflow.source.git.commit"] = (manifest.get("git") or {}).get("commit")
    return {key: value for key, value in tags.items() if value is not None}


def _all_metrics(run: Run) -> list[Metric]:
    """Return the log's values as `phase/name`, and the results by their nested names at the last step."""
    from mlflow.entities import Metric

    log = run.metrics()
    found = [
        Metric(f"{entry.phase}/{key}", value, int(entry.time * 1000), entry.step)
        for entry in log
        for key, value in entry.values.items()
    ]
    last, time = (log[-1].step, int(log[-1].time * 1000)) if log else (0, 0)
    results = {key.replace(".", "/"): value for key, value in flatten(run.results).items()}
    return found + [Metric(key, float(value), time, last) for key, value in results.items() if _number(value)]


def _chunks(items: list[Any], size: int) -> Iterator[list[Any]]:
    return (items[start : start + size] for start in range(0, len(items), size))


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _milliseconds(moment: str) -> int:
    return int(datetime.fromisoformat(moment).timestamp() * 1000)


@contextlib.contextmanager
def _quiet(loggers: Sequence[str] = CHATTY) -> Iterator[None]:
    """Keep MLflow and the packages that it uses from printing."""
    for key, value in QUIET.items():
        os.environ.setdefault(key, value)
    before = {name: logging.getLogger(name).level for name in loggers}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import mlflow  # noqa: F401  (it sets its own levels when it is first imported)

        for name in loggers:
            logging.getLogger(name).setLevel(logging.CRITICAL)
        try:
            yield
        finally:
            for name, level in before.items():
                logging.getLogger(name).setLevel(level)
