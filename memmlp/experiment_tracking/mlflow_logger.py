"""The logger that shows runs in MLflow: one MLflow run for each run folder, identified by a tag."""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import logging
import math
import os
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from filelock import FileLock

from memmlp.experiment_tracking.logged_values import CurvePoint, RunFacts, SweepFacts

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run as MlflowRun

QUIET = {
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "DO_NOT_TRACK": "true",
    "GIT_PYTHON_REFRESH": "quiet",
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1",  # it is tried again with longer and longer pauses anyway
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "10",
}
CHATTY = ("mlflow", "alembic", "urllib3")
EXPERIMENT = "memmlp"
STATUS = {
    "running": "RUNNING", "done": "FINISHED", "failed": "FAILED", "killed": "KILLED", "stopped": "KILLED",
}  # fmt: skip
PARAM_LENGTH, TAG_LENGTH = 6000, 5000  # MLflow's limits
PARAMS, METRICS = 100, 1000


@dataclass(frozen=True)
class MLflow:
    """Shows runs in MLflow.

    Attributes:
        uri: the tracking store; None for MLFLOW_TRACKING_URI, or else a sqlite file in the outputs folder.
        outputs: the outputs folder.
    """

    uri: str | None
    outputs: Path

    name = "mlflow"

    @property
    def place(self) -> str:
        """The URI of the store in which MLflow keeps its runs."""
        local = f"sqlite:///{self.outputs.absolute() / 'mlflow.db'}"
        return self.uri or os.environ.get("MLFLOW_TRACKING_URI") or local

    def has(self, run_id: str) -> bool:
        """Return whether MLflow has a run for that id."""
        with self._client() as client:
            return bool(found(client, experiment_id(client, self), run_id))

    def begin(self, facts: RunFacts, points: Sequence[CurvePoint]) -> ShownInMLflow:
        """Show a run: MLflow's run is updated, or replaced if it contradicts the folder."""
        with self._client() as client:
            experiment = experiment_id(client, self)
            kept = None
            for old in found(client, experiment, facts.id):
                if kept is None and not contradicts(client, old, facts, points):
                    kept = old
                else:
                    client.delete_run(old.info.run_id)
            if kept is None:
                start = int(facts.started * 1000)
                tags = {"memmlp.run_id": facts.id}
                kept = client.create_run(experiment, start, tags, run_name=facts.name)
            shown = ShownInMLflow(self, kept.info.run_id, _known(client, kept))
            describe(client, kept, facts)
        shown.log(points)
        return shown

    def sweep(self, facts: SweepFacts) -> None:
        """Make a sweep the parent of its runs, with its aggregates, verdicts and table.

        A run that several sweeps share stays a child of the first one; one tag per sweep holds the run's
        label in that sweep.
        """
        with self._client() as client:
            experiment = experiment_id(client, self)
            parent = _sweep_run(client, experiment, facts)
            for run_id, label in facts.arms.items():
                for child in found(client, experiment, run_id):
                    client.set_tag(child.info.run_id, f"memmlp.arm.{facts.name}", label)
                    if "mlflow.parentRunId" not in child.data.tags:
                        client.set_tag(child.info.run_id, "mlflow.parentRunId", parent)
            for path in facts.files:
                client.log_artifact(parent, str(path))
            client.set_terminated(parent, STATUS[facts.status])

    @contextlib.contextmanager
    def _client(self) -> Iterator[MlflowClient]:
        """Yield a client that prints nothing; a lock lets only one process at a time use a sqlite store."""
        self.outputs.mkdir(parents=True, exist_ok=True)
        local = self.place.startswith("sqlite:")
        guard = FileLock(self.outputs / ".mlflow.lock") if local else contextlib.nullcontext()
        with quiet(), guard:
            from mlflow import MlflowClient

            yield MlflowClient(tracking_uri=self.place)


@dataclass(frozen=True)
class ShownInMLflow:
    """A run as shown in MLflow.

    Attributes:
        logger: the logger.
        mlflow_id: MLflow's own id of the run.
        known: keys and steps of the values that MLflow has.
    """

    logger: MLflow
    mlflow_id: str
    known: set[tuple[str, int]]

    def log(self, points: Sequence[CurvePoint]) -> None:
        """Send the values that MLflow does not have yet, in batches."""
        from mlflow.entities import Metric

        new = {(point.key, point.step): point for point in points}
        metrics = [
            Metric(point.key, point.value, int(point.time * 1000), point.step)
            for place, point in new.items()
            if place not in self.known
        ]
        with self.logger._client() as client:
            for part in _chunks(metrics, METRICS):
                client.log_batch(self.mlflow_id, metrics=part)
                self.known.update((metric.key, metric.step) for metric in part)

    def end(self, facts: RunFacts, results: Sequence[CurvePoint]) -> None:
        """Send results and files, and end MLflow's run with the run's own status."""
        self.log(results)
        with self.logger._client() as client:
            describe(client, client.get_run(self.mlflow_id), facts)
            for path in facts.files:
                client.log_artifact(self.mlflow_id, str(path))
            if facts.ended is not None:
                client.set_terminated(self.mlflow_id, STATUS[facts.status], int(facts.ended * 1000))

    def leave(self) -> None:
        """Do nothing: MLflow keeps no run open."""


def experiment_id(client: MlflowClient, logger: MLflow) -> str:
    """Return the id of MLflow's experiment; it is created if it does not exist."""
    experiment = client.get_experiment_by_name(EXPERIMENT)
    if experiment is not None:
        return experiment.experiment_id
    local = logger.place.startswith("sqlite:")
    place = (logger.outputs.absolute() / "mlflow-artifacts").as_uri() if local else None
    return client.create_experiment(EXPERIMENT, artifact_location=place)


def found(client: MlflowClient, experiment: str, run_id: str) -> list[MlflowRun]:
    """Return MLflow's runs for a run id: one, unless somebody made more."""
    return list(client.search_runs([experiment], f"tags.`memmlp.run_id` = '{run_id}'"))


def contradicts(client: MlflowClient, old: MlflowRun, facts: RunFacts, points: Sequence[CurvePoint]) -> bool:
    """Return whether MLflow's run has anything that contradicts the folder.

    MLflow can't remove values and parameters, so such a run has to be made anew. It comes from an earlier
    start, or from steps that were repeated with other values.
    """
    if old.data.tags.get("memmlp.started") not in (None, facts.origin.get("started")):
        return True
    params = _params(facts)
    if any(params.get(key) != value for key, value in old.data.params.items()):
        return True
    every = {(point.key, point.step): point.value for point in points}
    every |= {(key, step): value for key, value in facts.results.items() for step in _steps(points)}
    return any(
        not _same(every.get((key, metric.step)), metric.value)
        for key in old.data.metrics
        for metric in client.get_metric_history(old.info.run_id, key)
    )


def _steps(points: Sequence[CurvePoint]) -> set[int]:
    """Return the step at which results are placed: the last one of training."""
    return {max((point.step for point in points if not point.key.startswith("system/")), default=0)}


def _same(a: float | None, b: float) -> bool:
    return a is not None and (a == b or (a != a and b != b))


def _known(client: MlflowClient, run: MlflowRun) -> set[tuple[str, int]]:
    keys = run.data.metrics
    return {(key, m.step) for key in keys for m in client.get_metric_history(run.info.run_id, key)}


def describe(client: MlflowClient, run: MlflowRun, facts: RunFacts) -> None:
    """Update the name, parameters, tags, note, dataset and source of MLflow's run."""
    from mlflow.entities import Param, RunTag

    name, tags = run.info.run_id, _run_tags(facts)
    params = [Param(key, value) for key, value in _params(facts).items() if key not in run.data.params]
    changed = [RunTag(k, v) for k, v in tags.items() if run.data.tags.get(k) != v]
    for part in _chunks(params, PARAMS):
        client.log_batch(name, params=part)
    for part in _chunks(changed, PARAMS):
        client.log_batch(name, tags=part)
    ours = ("memmlp.label.", "memmlp.failure", "memmlp.by_an_earlier_recipe", "mlflow.note.content")
    for key in run.data.tags:
        if key.startswith(ours) and key not in tags:
            client.delete_tag(name, key)
    if not run.inputs or not run.inputs.dataset_inputs:
        client.log_inputs(name, [_dataset(facts)])
    if facts.status == "running" and run.info.status != "RUNNING":
        client.update_run(name, status="RUNNING")


def _dataset(facts: RunFacts) -> Any:
    from mlflow.entities import Dataset, DatasetInput

    name, digest = facts.data
    # MLflow has room for 36 characters of a digest; the whole one is a tag.
    return DatasetInput(Dataset(name, digest[:36], "local", "{}"), [])


def _params(facts: RunFacts) -> dict[str, str]:
    return {key: value[:PARAM_LENGTH] for key, value in facts.config.items()}


def _run_tags(facts: RunFacts) -> dict[str, str]:
    tags = {f"memmlp.{key.replace(' ', '_')}": value for key, value in facts.origin.items()}
    tags |= {f"memmlp.label.{label}": "yes" for label in facts.tags}
    tags |= {"memmlp.run_id": facts.id, "memmlp.folder": str(facts.folder), "mlflow.runName": facts.name}
    tags |= {"mlflow.source.name": "memmlp", "mlflow.source.type": "LOCAL"}
    given = {
        "mlflow.source.git.commit": facts.origin.get("commit"),
        "mlflow.user": facts.origin.get("user"),
        "mlflow.note.content": facts.note or None,
        "memmlp.failure": facts.reason,
        "memmlp.by_an_earlier_recipe": facts.earlier or None,
    }
    tags |= {key: value for key, value in given.items() if value is not None}
    return {key: value[:TAG_LENGTH] for key, value in tags.items()}


def _sweep_run(client: MlflowClient, experiment: str, facts: SweepFacts) -> str:
    """Return MLflow's id of the sweep's run, after updating its aggregates and verdicts.

    MLflow can't remove a mean that is no more, so it becomes NaN.
    """
    from mlflow.entities import Metric, RunTag

    parents = client.search_runs([experiment], f"tags.`memmlp.sweep` = '{_quoted(facts.name)}'")
    tags = {"memmlp.sweep": facts.name}
    parent = parents[0] if parents else client.create_run(experiment, tags=tags, run_name=facts.name)
    name = parent.info.run_id
    verdicts = {f"verdict/{allowed(key)}": verdict for key, verdict in facts.verdicts.items()}
    for key in parent.data.tags:
        if key.startswith("verdict/") and key not in verdicts:
            client.delete_tag(name, key)
    for part in _chunks([RunTag(key, verdict) for key, verdict in verdicts.items()], PARAMS):
        client.log_batch(name, tags=part)
    aggregates = {allowed(key): value for key, value in facts.aggregates.items()}
    before = parent.data.metrics
    gone = {key: math.nan for key, value in before.items() if key not in aggregates and not math.isnan(value)}
    new = gone | {key: value for key, value in aggregates.items() if before.get(key) != value}
    step = max(
        (m.step for key in parent.data.metrics for m in client.get_metric_history(name, key)), default=-1
    )
    for part in _chunks([Metric(key, value, 0, step + 1) for key, value in new.items()], METRICS):
        client.log_batch(name, metrics=part)
    return name


def allowed(name: str) -> str:
    """Return a name with the characters that MLflow allows; if any were replaced, a digest is appended."""
    plain = re.sub(r"[^\w./ -]", "_", name)
    return plain if plain == name else f"{plain} {hashlib.sha256(name.encode()).hexdigest()[:4]}"


def _quoted(name: str) -> str:
    return name.replace("'", "\\'")


def _chunks(items: Sequence[Any], size: int) -> Iterator[list[Any]]:
    return (list(items[start : start + size]) for start in range(0, len(items), size))


@contextlib.contextmanager
def quiet(loggers: Sequence[str] = CHATTY) -> Iterator[None]:
    """Keep MLflow and the packages that it uses from printing."""
    for key, value in QUIET.items():
        os.environ.setdefault(key, value)
    before: Mapping[str, int] = {name: logging.getLogger(name).level for name in loggers}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        importlib.import_module("mlflow")  # it sets its own levels when it is first imported
        for name in loggers:
            logging.getLogger(name).setLevel(logging.CRITICAL)
        try:
            yield
        finally:
            for name, level in before.items():
                logging.getLogger(name).setLevel(level)
