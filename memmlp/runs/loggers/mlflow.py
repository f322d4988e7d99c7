"""Shows runs in MLflow: one MLflow run for each run folder, with a tag for the run's id."""

from __future__ import annotations

import contextlib
import logging
import os
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from memmlp.common.components import component
from memmlp.common.errors import check_installed
from memmlp.common.settings import Settings, setting
from memmlp.common.text_formats import make_key, make_sqlite_url
from memmlp.runs.loggers.logger import CurvePoint, RunFacts

if TYPE_CHECKING:
    from mlflow import MlflowClient

ENVIRONMENT = {
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "DO_NOT_TRACK": "true",
    "GIT_PYTHON_REFRESH": "quiet",
    "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1",  # failed loggers are tried again anyway
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "10",
}
EXPERIMENT = "memmlp"
STATUS = {"running": "RUNNING", "done": "FINISHED", "failed": "FAILED", "killed": "KILLED"}
PARAM_LENGTH, TAG_LENGTH, PARAMS, METRICS = 6000, 5000, 100, 1000  # MLflow's limits


@component("loggers", "mlflow", builds="MLflow")
@dataclass
class MLflowSettings(Settings):
    """Shows runs in MLflow while they are in progress.

    It needs pip install 'memmlp[mlflow]'.
    """

    uri: str | None = setting(default=None)  # null: MLFLOW_TRACKING_URI if set, or SQLite in paths.outputs


@dataclass(frozen=True)
class MLflow:
    """Shows runs in MLflow at the store `uri`; None for MLFLOW_TRACKING_URI, or a sqlite file in the outputs
    folder. All output of MLflow's packages is suppressed. Raises InputError if MLflow is not installed."""

    uri: str | None
    outputs: Path

    name = "mlflow"

    def __post_init__(self) -> None:
        check_installed("mlflow", "mlflow", "loggers=mlflow")

    @property
    def place(self) -> str:
        """The URI of MLflow's tracking store."""
        local = make_sqlite_url(self.outputs.absolute() / "mlflow.db")
        return self.uri or os.environ.get("MLFLOW_TRACKING_URI") or local

    def fingerprint(self, run_id: str) -> str | None:
        """Return the fingerprint that MLflow stores for a finished run; None without one."""
        with self.client() as (client, experiment):
            runs = client.search_runs([experiment], f"tags.`memmlp.run_id` = '{run_id}'")
        return runs[0].data.tags.get("memmlp.fingerprint") if len(runs) == 1 else None

    def begin(self, facts: RunFacts, points: Sequence[CurvePoint]) -> ShownInMLflow:
        """Show a run; an existing MLflow run is replaced, since MLflow can't remove values."""
        from mlflow.entities import Dataset, DatasetInput, Param

        with self.client() as (client, experiment):
            tags = {"memmlp.run_id": facts.id} | _build_tags(facts)
            for old in client.search_runs([experiment], f"tags.`memmlp.run_id` = '{facts.id}'"):
                client.delete_run(old.info.run_id)
            start = int(facts.started * 1000)
            run_id = client.create_run(experiment, start, tags, run_name=facts.name).info.run_id
            params = [Param(_make_key(key), value[:PARAM_LENGTH]) for key, value in facts.config.items()]
            for batch in _split_into_batches(params, PARAMS):
                client.log_batch(run_id, params=batch)
            name, digest = facts.data  # MLflow allows 36 characters of a digest; a tag has all of it
            client.log_inputs(run_id, [DatasetInput(Dataset(name[:500], digest[:36], "local", "{}"), [])])
        shown = ShownInMLflow(self, run_id)
        shown.log(points)
        return shown

    @contextlib.contextmanager
    def client(self) -> Iterator[tuple[MlflowClient, str]]:
        """Yield a client and the experiment's id; only one process at a time uses a sqlite store."""
        os.environ.update({name: os.environ.get(name, value) for name, value in ENVIRONMENT.items()})
        warnings.filterwarnings("ignore", module=r"(mlflow|alembic|sqlalchemy|pydantic)\b")
        from filelock import FileLock
        from mlflow import MlflowClient
        from mlflow.exceptions import MlflowException

        for package in ("mlflow", "alembic", "urllib3"):
            logging.getLogger(package).setLevel(logging.CRITICAL)
        self.outputs.mkdir(parents=True, exist_ok=True)
        local = self.place.startswith("sqlite:")
        with FileLock(self.outputs / ".mlflow.lock") if local else contextlib.nullcontext():
            if self.place == make_sqlite_url(database := self.outputs.absolute() / "mlflow.db"):
                database.touch()  # with the mode of other files; SQLite's own is 0644
            client = MlflowClient(tracking_uri=self.place)
            stray = Path(quote(str(self.outputs.absolute())))
            if local and stray != self.outputs.absolute():
                with contextlib.suppress(OSError):  # MLflow makes an empty folder with the URL's escapes
                    os.removedirs(stray)
            if client.get_experiment_by_name(EXPERIMENT) is None:
                artifacts = (self.outputs.absolute() / "mlflow-artifacts").as_uri() if local else None
                with contextlib.suppress(MlflowException):  # another process has created it meanwhile
                    client.create_experiment(EXPERIMENT, artifact_location=artifacts)
            experiment = client.get_experiment_by_name(EXPERIMENT)
            assert experiment is not None
            if experiment.lifecycle_stage == "deleted":
                client.restore_experiment(experiment.experiment_id)
            yield client, experiment.experiment_id


@dataclass(frozen=True)
class ShownInMLflow:
    logger: MLflow
    mlflow_id: str

    def log(self, points: Sequence[CurvePoint]) -> None:
        with self.logger.client() as (client, _):
            _send_points(client, self.mlflow_id, points)

    def end(self, facts: RunFacts) -> None:
        """Send results, tags and files, and set the final status of the MLflow run."""
        from mlflow.entities import RunTag

        with self.logger.client() as (client, _):
            _send_points(client, self.mlflow_id, facts.results)
            for path in facts.files:
                client.log_artifact(self.mlflow_id, str(path))
            tags = _build_tags(facts) | {"memmlp.fingerprint": facts.fingerprint}
            for batch in _split_into_batches([RunTag(*pair) for pair in tags.items()], PARAMS):
                client.log_batch(self.mlflow_id, tags=batch)
            client.set_terminated(self.mlflow_id, STATUS[facts.status], int((facts.ended or 0) * 1000))

    def close(self) -> None:
        """Do nothing: MLflow does not keep runs open."""


def _send_points(client: MlflowClient, mlflow_id: str, points: Sequence[CurvePoint]) -> None:
    from mlflow.entities import Metric

    for batch in _split_into_batches(points, METRICS):
        metrics = [
            Metric(_make_key(point.key), point.value, int(point.time * 1000), point.step) for point in batch
        ]
        client.log_batch(mlflow_id, metrics=metrics)


def _split_into_batches(items: Sequence[Any], size: int) -> Iterator[list[Any]]:
    return (list(items[start : start + size]) for start in range(0, len(items), size))


def _make_key(text: str) -> str:
    return make_key(text, r"\w. :/-", 250)


def _build_tags(facts: RunFacts) -> dict[str, str]:
    tags = {f"memmlp.{key.replace(' ', '_')}": value for key, value in facts.origin.items()}
    tags |= {_make_key(f"memmlp.label.{label}"): label for label in facts.tags}
    given = {
        "memmlp.folder": str(facts.folder),
        "mlflow.source.name": "memmlp",
        "mlflow.source.type": "LOCAL",
        "mlflow.source.git.commit": facts.origin.get("commit"),
        "mlflow.user": facts.origin.get("user"),
        "mlflow.note.content": facts.note,
        "memmlp.failure": facts.reason,
        "memmlp.outdated_results": facts.outdated,
    }
    tags |= {key: value for key, value in given.items() if value}
    return {key: value[:TAG_LENGTH] for key, value in tags.items()}
