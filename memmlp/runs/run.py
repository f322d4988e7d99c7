"""Run folders: lock, manifest, metrics log, completion. The folder is the only record of a run.

A run is done when it is trained. Its folder contains its evaluations and deployments. Each is a file or
folder that is named by its id. It is complete or absent.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import yaml

from memmlp.common.errors import InputError, RunStopped
from memmlp.common.files import atomic_write, file_digest, now, sync_folder, write_json
from memmlp.common.lease import Lease, Lock, check_owner
from memmlp.common.overrides import flatten
from memmlp.common.text_formats import join_command
from memmlp.runs import deployment_folder, records
from memmlp.runs.deployment_folder import DeploymentFolder, replace_with_deployed_times
from memmlp.runs.environment import (
    create_code_patch,
    describe_environment,
    describe_sources,
    hash_host_name,
    list_changed_files,
    merge_run_origins,
)
from memmlp.runs.evaluation_file import ConfiguredEvaluations, add_solver_names, is_intact
from memmlp.runs.identity import (
    belongs_to_folder,
    describe_export_difference,
    find_training_settings,
    has_configured_inference,
    select_deployment_settings,
)
from memmlp.runs.metrics_log import LogRecord, MetricsLog

STAGE_WORDS = {"training": "training", "evaluation": "evaluating", "deployment": "exporting"}
"""The status of a run while a process works on a stage, by stage."""

STOPPED = "stopped on request"

STATUSES = (
    *STAGE_WORDS.values(), "done", "trained", "lost", "failed", "damaged", "stopped", "interrupted", "new",
)  # fmt: skip
"""The statuses of runs (`Run.state`)."""


def name_latency(deployed: DeploymentFolder, config: Mapping[str, Any]) -> str:
    """Return "latency", or a name such as "latency-int8" for a file that the config does not request."""
    return "-".join(filter(None, ["latency", describe_export_difference(deployed.settings, config)]))


class Run:
    """A run: the folder outputs/runs/<id>/. `results_path` has a VQ-VAE's results; `marker` marks the run as
    done."""

    STAGES = (*(f"deployments/*/{name}" for name in deployment_folder.FILES), "evaluations/*.json")
    """The files of a run's evaluations and deployments."""
    FILES = (
        *STAGES, "checkpoint.safetensors", "model.safetensors", "results.json", "metrics.jsonl", "poses.png",
        "log.txt", "FAILED", "STOP", "PRIORITY", "code.patch", "config.yaml", "manifest.json",
    )  # fmt: skip
    """All files of a run in order of removal: results before the files on which they depend."""

    def __init__(self, folder: Path | str):
        self.folder = Path(folder)
        self.id = self.folder.name
        self._kind: str | None = None
        self.config_path = self.folder / "config.yaml"
        self.manifest_path = self.folder / "manifest.json"
        self.metrics_path = self.folder / "metrics.jsonl"
        self.checkpoint = self.folder / "checkpoint.safetensors"
        self.model = self.folder / "model.safetensors"
        self.picture = self.folder / "poses.png"
        self.results_path = self.folder / "results.json"
        self.evaluations = self.folder / "evaluations"
        self.deployments = self.folder / "deployments"
        self.marker = self.folder / "DONE"
        self.stop_path = self.folder / "STOP"
        self.priority_path = self.folder / "PRIORITY"
        self.log_path = self.folder / "log.txt"
        self.notes_path = self.folder / "notes.json"
        self._lock, self._log = Lock(self.folder), MetricsLog(self.metrics_path)

    @classmethod
    def from_id(cls, outputs: Path | str, run_id: str) -> Run:
        """Return the run with an id in an outputs folder; its folder may not exist."""
        return cls(Path(outputs) / "runs" / run_id)

    def evaluation(self, identity: str) -> Path:
        """Return the path of an evaluation file; it may not exist."""
        return self.evaluations / f"{identity}.json"

    def deployment(self, identity: str) -> DeploymentFolder:
        """Return the folder of a deployment; it may not exist."""
        return DeploymentFolder(self.deployments / identity)

    def has(self, stage: str) -> bool:
        """Return whether the run has the evaluation or deployment with this id."""
        return self.evaluation(stage).is_file() or self.deployment(stage).done

    @property
    def requested_stages(self) -> tuple[str, ...]:
        """The ids of the evaluations and the deployment in the last request; empty for a prerequisite run."""
        return tuple(self.manifest.get("stages", ()))

    def request_stages(self, stages: Sequence[str]) -> None:
        """Record the ids of the requested evaluations and deployment."""
        if self.manifest.get("stages") != list(stages):
            self.write_manifest({"stages": list(stages)})

    @property
    def complete(self) -> bool:
        """Whether the run is trained and has all requested evaluations and deployments."""
        return self.done and all(map(self.has, self.requested_stages))

    @property
    def preferred_deployment(self) -> DeploymentFolder:
        """The deployment for live use, like the run's config. The order of preference is: current component
        versions, an accurate int8 file, the export settings of the config, the latest."""
        config = self.config
        return self._find_best_deployment(
            config,
            lambda one: (
                one.is_current, bool(one.accurate_int8_file),
                not describe_export_difference(one.settings, config), one.record.get("made", ""),
            ),
        )  # fmt: skip

    def find_shown_deployment(self, config: Mapping[str, Any]) -> DeploymentFolder:
        """Return the deployment with the measurements for tables, given the run's config. The order of
        preference is: the export settings of the config, current component versions, exactly the settings of
        the config, the latest. `name_latency` names different export settings."""
        requested = select_deployment_settings(config)
        return self._find_best_deployment(
            config,
            lambda one: (
                not describe_export_difference(one.settings, config), one.is_current,
                one.settings == requested, one.record.get("made", ""),
            ),
        )  # fmt: skip

    def _find_best_deployment(
        self, config: Mapping[str, Any], sort_key: Callable[[DeploymentFolder], tuple[Any, ...]]
    ) -> DeploymentFolder:
        every = [DeploymentFolder(path.parent) for path in self.deployments.glob("*/latency.json")]
        matching = [one for one in every if one.done and has_configured_inference(one.settings, config)]
        return max(matching, key=sort_key, default=None) or DeploymentFolder(self.deployments / "none")

    @property
    def preferred_onnx(self) -> Path:
        """The ONNX file for live use: int8 if it is accurate enough, otherwise float32. Raises InputError if
        a finished run does not have one (`export.graph=off`), or if it has changed."""
        deployment = self.preferred_deployment
        if self.done and not self.deployments.is_dir():
            make = join_command(["memmlp", "eval", str(self.folder), "export.graph=auto"])
            raise InputError(f"{self.folder}: does not have step.onnx; export it with {make}")
        file = deployment.accurate_int8_file or deployment.onnx
        digest = deployment.record.get("artifacts", {}).get(file.name)
        if digest and not self._same(str(file.relative_to(self.folder)), digest):
            raise InputError(f"{file}: changed since it was exported; repeat the run with force=true")
        return file

    def __repr__(self) -> str:
        return f"Run({str(self.folder)!r})"

    def lock(self, wait: bool = True) -> AbstractContextManager[Lease | None]:
        """Hold the run's lock during the context, and yield the lease (`Lock.hold`)."""
        return self._lock.hold(wait)

    @property
    def status(self) -> str:
        """The run's status, one of STATUSES: the activity of a process, otherwise the run's progress."""
        if activity := self.activity:
            return activity
        word = self.state(self.complete and not self.failure)
        return "trained" if word == "running" else word  # a process holds the run without working on a stage

    @property
    def is_held(self) -> bool | None:
        """Whether a process works on the run; False if it died, None if none did (`Lock.is_held`)."""
        return self._lock.is_held

    @property
    def activity(self) -> str | None:
        """The current activity: training, evaluating or exporting; None if no process works on the run."""
        if not self.is_held:
            return None
        attempts = self.manifest.get("attempts") or [{}]
        word = STAGE_WORDS.get(attempts[-1].get("stage"), "training")
        return None if self.done and word == "training" else word

    def state(self, complete: bool) -> str:
        """Return the state of the run, given whether the caller considers it complete: done, running (a
        process works on it), lost (its process died), failed, damaged (a record cannot be read), trained (a
        requested evaluation or deployment is missing), stopped (on request), interrupted, new."""
        if complete and not self.damage:
            return "done"
        held = self.is_held
        if self.is_stop_requested and not held and not self.failure:
            return "stopped"
        if held is not None:
            return "running" if held else "lost"
        if self.failure:
            return "failed"
        if self.damage:
            return "damaged"
        if self.done:
            return "trained"
        return "interrupted" if self.manifest_path.exists() else "new"

    @property
    def failure(self) -> str | None:
        """The reason why the run failed, in one line; None if it has not failed."""
        return records.read(self.folder / "FAILED", records.Failure).get("reason")

    @property
    def damage(self) -> list[str]:
        """A line for each record that cannot be read, with the file and the reason."""
        files = {
            self.config_path: records.Config,
            self.manifest_path: records.Manifest,
            self.marker: records.Marker,
            self.folder / "FAILED": records.Failure,
            self.notes_path: records.Notes,
            self.results_path: records.Tree,
            **dict.fromkeys(sorted(self.evaluations.glob("*.json")), records.Evaluation),
            **dict.fromkeys(sorted(self.deployments.glob("*/latency.json")), records.Deployment),
        }
        found = [line for path, kind in files.items() if (line := records.find_damage(path, kind))]
        missing = [path for path in (self.config_path, self.manifest_path) if not path.exists()]
        found += [f"{path}: missing" for path in missing if self.marker.exists()]
        return found + list(filter(None, [self._log.find_damage()]))

    @property
    def fault(self) -> str | None:
        """The reason why the run failed, or else its damaged record or a request to stop; otherwise None."""
        stopped = STOPPED if self.is_stop_requested and not self.complete else None
        return self.failure or next(iter(self.damage), stopped)

    def check_records(self) -> None:
        """Raise InputError if a record of the run cannot be read."""
        if damage := self.damage:
            more = f" (and {len(damage) - 1} more)" if len(damage) > 1 else ""
            raise InputError(f"{damage[0]}{more}; remove the file, or the run folder to repeat the run")

    def fail(self, reason: str, details: str = "") -> None:
        """Record the reason why the run failed."""
        failure = {"reason": " ".join(reason.split()), "when": now(), "details": details}
        write_json(self.folder / "FAILED", failure)

    @property
    def is_stop_requested(self) -> bool:
        """Whether somebody asked for the end of the run's work."""
        return self.stop_path.exists()

    def request_stop(self) -> None:
        """Ask for the end of the run's work, from any process: its worker writes a checkpoint at its next
        step and stops. No worker continues the run before `retry`."""
        self.folder.mkdir(parents=True, exist_ok=True)
        write_json(self.stop_path, {"when": now()})

    @property
    def is_prioritized(self) -> bool:
        """Whether workers take the run before other runs of their plan."""
        return self.priority_path.exists()

    def prioritize(self, wanted: bool = True) -> None:
        """Ask workers to take the run before other runs, or no longer."""
        if not wanted:
            return self.priority_path.unlink(missing_ok=True)
        self.folder.mkdir(parents=True, exist_ok=True)
        write_json(self.priority_path, {"when": now()})

    def check_not_stopped(self) -> None:
        """Raise RunStopped if somebody asked for the end of the run's work."""
        if self.is_stop_requested:
            raise RunStopped(self.stop_message)

    @property
    def stop_message(self) -> str:
        """The line that says how to continue a stopped run."""
        return f"run {self.id}: {STOPPED}; continue it with: memmlp runs retry {self.id}"

    def retry(self) -> None:
        """Remove a request to stop and the record of the failure, so that workers continue the run."""
        self.stop_path.unlink(missing_ok=True)
        self.forget_failure()

    def forget_failure(self) -> None:
        """Remove the record of the failure, and stop counting the attempts that led to it."""
        if self.failure:
            self.reset_deaths()
        check_owner(self.folder)
        (self.folder / "FAILED").unlink(missing_ok=True)

    def reset_deaths(self) -> None:
        """Stop counting earlier attempts as dead: the run has succeeded, or is tried again."""
        manifest = self.manifest
        attempts = len(manifest.get("attempts", []))
        if attempts > manifest.get("forgiven", 0):
            self.write_manifest({"forgiven": attempts})

    def begin(
        self, kind: str, config: Mapping[str, Any], *, data: str, prerequisite: str | None, **facts: Any
    ) -> None:
        """Write config.yaml and the manifest of a run that starts or resumes, and a patch of uncommitted
        changes. `kind` is that of `Identity`, `data` the data's digest, `prerequisite` the id of the run that
        provides weights. `facts` are further manifest entries."""
        self.folder.mkdir(parents=True, exist_ok=True)
        atomic_write(self.config_path, yaml.safe_dump(dict(config), sort_keys=False, allow_unicode=True))
        if patch := create_code_patch():
            atomic_write(self.folder / "code.patch", patch)
        identity = {"id": self.id, "kind": kind, "data": data, "prerequisite": prerequisite}
        before = self.manifest if self.checkpoint.exists() else {}
        sources = describe_sources(facts.get("plugins", ()))
        origin = merge_run_origins(before, {**facts, **describe_environment(), **sources})
        self.attempt("training")
        times = {"started": self.manifest.get("started", now()), "finished": None, "seconds": {}}
        self.write_manifest(identity | times | origin)

    def record_seconds(self, stage: str, seconds: float) -> None:
        """Record the duration of a stage in the manifest, summed over all attempts."""
        recorded = self.manifest.get("seconds", {})
        self.write_manifest({"seconds": {**recorded, stage: round(seconds, 3)}})

    def attempt(self, stage: str) -> None:
        """Record that this process begins to work on a stage of the run."""
        self.forget_failure()
        attempt = {
            "started": now(),
            "pid": os.getpid(),
            "host": hash_host_name(),
            "step": self.step,
            "stage": stage,
        }
        self.write_manifest({"attempts": [*self.manifest.get("attempts", []), attempt]})

    def write_manifest(self, fields: Mapping[str, Any]) -> None:
        """Add or replace fields of the manifest. Raises InputError if it can't be read."""
        manifest = records.load(self.manifest_path, records.Manifest)
        write_json(self.manifest_path, manifest | dict(fields))

    @property
    def manifest(self) -> dict[str, Any]:
        """The facts about the run; empty before it began."""
        found = records.read(self.manifest_path, records.Manifest)
        self._kind = found.get("kind")
        return found

    @property
    def kind(self) -> str | None:
        """What the run trained, which never changes; a list of many runs reads each manifest once."""
        return self._kind or self.manifest.get("kind")

    @property
    def config(self) -> dict[str, Any]:
        """The resolved config; empty before the run began. Raises InputError if the file is damaged."""
        return records.load(self.config_path, records.Config)

    @property
    def results(self) -> dict[str, Any]:
        """The results with the run's own settings: mode -> branch -> metric, and "latency". If the exported
        file differs from the requested one, the key names the difference: "latency-int8". Of several kinds of
        inverse kinematics, the kind in the run's config counts, or else the last kind. The results of a
        VQ-VAE have other keys. Raises InputError if an evaluation file is damaged."""
        results = records.read(self.results_path, records.Tree) | self.configured_evaluations.results
        config = self.config
        deployed = self.find_shown_deployment(config)
        return results | ({name_latency(deployed, config): deployed.record} if deployed.record else {})

    @property
    def flat_results(self) -> dict[str, Any]:
        """The results by dotted key, which names the inverse kinematics. Times and size are those of the file
        that the config requests. Raises InputError if an evaluation file is damaged."""
        named = add_solver_names(self.results, self.configured_evaluations.combined_solvers)
        return flatten(replace_with_deployed_times(named))

    @property
    def configured_evaluations(self) -> ConfiguredEvaluations:
        """The evaluations that match the config of the run; each access reads the files."""
        return ConfiguredEvaluations(self.evaluations, self.config)

    @property
    def changed_sources(self) -> list[str]:
        """The code files, also of users' packages, that have changed since the run began."""
        return list_changed_files(self.manifest)

    def log(self, step: int, values: Mapping[str, float], phase: str = "train") -> None:
        """Append one line to the metrics log (`MetricsLog.append`)."""
        self._log.append(step, values, phase)

    @property
    def step(self) -> int:
        """The last logged training step; 0 before the first."""
        return max((entry.step for entry in self.metrics() if entry.phase != "system"), default=0)

    @property
    def kept_validation(self) -> LogRecord | None:
        """The validation of the run's weights: the best one with `optim.best_by`, otherwise the last one."""
        found = [entry for entry in self.metrics() if entry.phase == "val"]
        best = self.manifest.get("best_step")
        return next((entry for entry in reversed(found) if best in (None, entry.step)), None)

    @property
    def total_steps(self) -> int:
        """The number of steps of the whole training; 0 if unknown, or for imported weights."""
        if self.manifest.get("imported"):
            return 0
        if steps := self.manifest.get("steps"):
            return int(steps)
        try:
            return int(find_training_settings(str(self.manifest.get("kind")), self.config)["steps"] or 0)
        except (KeyError, TypeError, ValueError):
            return 0

    @property
    def recent_metrics(self) -> list[LogRecord]:
        """The last records of the metrics log; empty if it is damaged."""
        try:
            return self._log.read_tail()
        except InputError:
            return []

    def metrics(self) -> list[LogRecord]:
        """Return all records of the metrics log (`MetricsLog.read`)."""
        return self._log.read()

    def finish(self, artifacts: Sequence[str]) -> None:
        """Mark the run as done, by writing the marker file with the artifacts' digests."""
        finished = now()
        self.write_manifest({"finished": finished})
        digests = {name: file_digest(self.folder / name) for name in artifacts}
        write_json(self.marker, {"id": self.id, "finished": finished, "artifacts": digests})

    @property
    def done(self) -> bool:
        """Whether the training is finished, and the marker file belongs to this run."""
        marker = records.read(self.marker, records.Marker)
        return "artifacts" in marker and belongs_to_folder(marker.get("id"), self.folder)

    @property
    def weights_digest(self) -> str | None:
        """The SHA-256 of the weights at the end of training; None before."""
        return records.read(self.marker, records.Marker).get("artifacts", {}).get(self.model.name)

    def weights(self) -> Path:
        """Return the file of the trained weights. Raises InputError if it has changed since the training."""
        digest = self.weights_digest
        if digest and not self._same(self.model.name, digest):
            raise InputError(f"{self.model}: changed since the training; repeat the run with force=true")
        return self.model

    def verify(self) -> list[str]:
        """Return the artifacts of a finished run that are missing or have changed."""
        artifacts = dict(records.read(self.marker, records.Marker).get("artifacts", {}))
        for latency in sorted(self.deployments.glob("*/latency.json")):
            where = latency.parent.relative_to(self.folder)
            exported = records.read(latency, records.Deployment).get("artifacts", {})
            artifacts |= {str(where / name): digest for name, digest in exported.items()}
        changed = [name for name, digest in artifacts.items() if not self._same(name, digest)]
        reports = sorted(self.evaluations.glob("*.json"))
        return changed + [str(path.relative_to(self.folder)) for path in reports if not is_intact(path)]

    def _same(self, name: str, digest: str) -> bool:
        path = self.folder / name
        return path.is_file() and file_digest(path) == digest

    def reset(self) -> None:
        """Remove all files of the run, the marker first; keep other files in its folder."""
        if not self.folder.exists():
            return
        check_owner(self.folder)
        self.marker.unlink(missing_ok=True)
        sync_folder(self.folder)
        self._remove((*self.FILES, self.marker.name))

    def clear_stages(self) -> None:
        """Remove the evaluations and deployments, since they belong to earlier weights."""
        self._remove(self.STAGES)

    def _remove(self, names: Iterable[str]) -> None:
        check_owner(self.folder)
        for name in names:
            temporary = str(Path(name).with_name(f".{Path(name).name}.*.tmp"))
            for path in (*self.folder.glob(name), *self.folder.glob(temporary)):
                path.unlink(missing_ok=True)
        for folder in (*self.deployments.glob("*/"), self.evaluations, self.deployments):
            with contextlib.suppress(OSError):  # it does not exist, or contains files of the user
                folder.rmdir()
        sync_folder(self.folder)
