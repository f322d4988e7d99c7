"""Run folders: lock, manifest, metrics log, completion. The folder is the only record of a run.

A run is done when it is trained. Its evaluations and deployments are below its folder, each in a file or
folder that is named by its identity and is either complete or absent.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import yaml

from memmlp.common.errors import InputError
from memmlp.common.files import atomic_write, file_digest, now, read_json, sync_folder, write_json
from memmlp.common.lease import Lease, Lock, check_owner
from memmlp.runs import deployment_folder
from memmlp.runs.deployment_folder import DeploymentFolder
from memmlp.runs.environment import changed_since, changes, describe_sources, environment, host, join_origins
from memmlp.runs.evaluation_file import EvaluationsAsConfigured, intact
from memmlp.runs.identity import belongs, deployment_settings, describe_other_export, used_as_configured
from memmlp.runs.metrics_log import LogRecord, MetricsLog

STAGE_WORDS = {"training": "training", "evaluation": "evaluating", "deployment": "exporting"}
"""What a process does that works on a stage of a run."""

STATUSES = (*STAGE_WORDS.values(), "done", "trained", "lost", "failed", "stopped", "new")
"""The statuses of runs; a lost run's process died (see `Run.state`)."""

LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # the C loader is six times as fast


@functools.lru_cache(maxsize=16)
def _parse(text: str) -> Any:
    return yaml.load(text, LOADER)


def latency_name(deployed: DeploymentFolder, config: Mapping[str, Any]) -> str:
    """Return the name of a deployment's results: "latency", or another file's, such as "latency-int8"."""
    return "-".join(filter(None, ["latency", describe_other_export(deployed.settings, config)]))


class Run:
    """A run: the folder outputs/runs/<id>/.

    Attributes:
        folder: the folder; its name is the run's `id`.
        id: 16 hex digits.
        config_path: the resolved config; `config` is its content.
        manifest_path: the facts about the run; `manifest` is its content.
        metrics_path: the metrics log; `metrics()` is its content.
        checkpoint: the last checkpoint.
        model: the trained weights.
        picture: the picture of truth and prediction.
        results_path: results of a VQ-VAE's run.
        evaluations: the folder of evaluations.
        deployments: the folder of deployments.
        marker: the file that marks the run as done.
    """

    STAGES = (*(f"deployments/*/{name}" for name in deployment_folder.FILES), "evaluations/*.json")
    """The files of a run's evaluations and deployments."""
    FILES = (
        *STAGES,
        "checkpoint.safetensors",
        "model.safetensors",
        "results.json",
        "metrics.jsonl",
        "poses.png",
        "FAILED",
        "code.patch",
        "config.yaml",
        "manifest.json",
    )
    """A run's own files, in the order in which a reset removes them: results before what they are of."""

    def __init__(self, folder: Path | str):
        self.folder = Path(folder)
        self.id = self.folder.name
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
        self._lock, self._log = Lock(self.folder), MetricsLog(self.metrics_path)

    @classmethod
    def of(cls, outputs: Path | str, run_id: str) -> Run:
        """Return the run with that id below an outputs folder, whether or not it exists."""
        return cls(Path(outputs) / "runs" / run_id)

    def evaluation(self, identity: str) -> Path:
        """Return the file of an evaluation, whether or not it was made."""
        return self.evaluations / f"{identity}.json"

    def deployment(self, identity: str) -> DeploymentFolder:
        """Return the folder of a deployment, whether or not it was made."""
        return DeploymentFolder(self.deployments / identity)

    def has(self, stage: str) -> bool:
        """Return whether the evaluation or deployment with that identity was made."""
        return self.evaluation(stage).is_file() or self.deployment(stage).done

    @property
    def wanted(self) -> tuple[str, ...]:
        """The identities of the evaluations and the deployment that were last asked for.

        Empty for a prerequisite run.
        """
        return tuple(self.manifest.get("stages", ()))

    def want(self, stages: Sequence[str]) -> None:
        """Record which evaluations and which deployment are asked for, by their identities."""
        if self.manifest.get("stages") != list(stages):
            self.write_manifest({"stages": list(stages)})

    @property
    def complete(self) -> bool:
        """Whether the run is trained and has the evaluations and the deployment that were last asked for."""
        return self.done and all(map(self.has, self.wanted))

    @property
    def preferred_deployment(self) -> DeploymentFolder:
        """The deployment to use live, among those that use the network as the run's config does.

        One with the current component versions is preferred, then one whose int8 file is accurate enough,
        then one of the file that the config asks for, then the one that was made last.
        """
        config = self.config
        return self._best_deployment(
            config,
            lambda one: (
                one.current, bool(one.accurate_int8), not describe_other_export(one.settings, config),
                one.made,
            ),
        )  # fmt: skip

    @property
    def deployment_as_configured(self) -> DeploymentFolder:
        """The deployment with the measurements that are shown (see `deployment_shown`)."""
        return self.deployment_shown(self.config)

    def deployment_shown(self, config: Mapping[str, Any]) -> DeploymentFolder:
        """Return the deployment with the measurements that are shown, given the run's config.

        It is of the file that the config asks for, whatever else was exported since; if there are several,
        one with the present component versions, then one with just the config's settings, then the last. Only
        if it is missing, another is shown and named (`latency_name`).
        """
        asked = deployment_settings(config)
        return self._best_deployment(
            config,
            lambda one: (
                not describe_other_export(one.settings, config), one.current, one.settings == asked, one.made,
            ),
        )  # fmt: skip

    def _best_deployment(
        self, config: Mapping[str, Any], rank: Callable[[DeploymentFolder], tuple[Any, ...]]
    ) -> DeploymentFolder:
        made = [DeploymentFolder(path.parent) for path in self.deployments.glob("*/latency.json")]
        own = [one for one in made if one.done and used_as_configured(one.settings, config)]
        return max(own, key=rank, default=None) or DeploymentFolder(self.deployments / "none")

    @property
    def preferred_onnx(self) -> Path:
        """The ONNX file to use: int8 if that is accurate enough (`export.precision`), else float32.

        Raises:
            InputError: if the run is finished and has no ONNX file (`export.graph=off`), or the file was
                changed since it was made.
        """
        deployment = self.preferred_deployment
        if self.done and not self.deployments.is_dir():
            make = f"memmlp eval {self.folder} export.graph=auto"
            raise InputError(f"{self.folder}: has no step.onnx; make one with {make}")
        file = deployment.accurate_int8 or deployment.onnx
        digest = deployment.record.get("artifacts", {}).get(file.name)
        if digest and not self._same(str(file.relative_to(self.folder)), digest):
            raise InputError(f"{file}: not the file that was exported; do the run again with force=true")
        return file

    @property
    def onnx(self) -> Path:
        """The float32 ONNX file of the deployment to use."""
        return self.preferred_deployment.onnx

    def __repr__(self) -> str:
        return f"Run({str(self.folder)!r})"

    def lock(
        self, say: Callable[[str], None] | None = None, wait: bool = True
    ) -> AbstractContextManager[Lease | None]:
        """Hold the run's lock for this process, which may hold it already; yields the lease.

        Once another process has taken over the run, any attempt of this one to write to it raises LeaseLost.

        Args:
            say: gets a line about the process for which this one waits; by default the line goes to stderr.
            wait: whether to wait while another process holds the run; otherwise None is yielded.
        """
        return self._lock.hold(say, wait)

    @property
    def status(self) -> str:
        """The run's status, one of STATUSES: what a process is doing with it, or else its progress."""
        if doing := self.doing:
            return doing
        word = self.state(self.complete and not self.failure)
        return "trained" if word == "running" else word  # held by a process, at no stage

    @property
    def doing(self) -> str | None:
        """What a process is doing with the run, one of STAGE_WORDS; None if no process works on it."""
        if not self._lock.held:
            return None
        attempts = self.manifest.get("attempts") or [{}]
        word = STAGE_WORDS.get(attempts[-1].get("stage"), "training")
        return None if self.done and word == "training" else word

    def state(self, complete: bool) -> str:
        """Return the state of the work on the run, given whether that work is complete.

        One of: done, running (a process works on it), lost (its process died), failed, trained (a wanted
        evaluation or deployment was not made yet), stopped, new.
        """
        if complete:
            return "done"
        if (held := self._lock.held) is not None:
            return "running" if held else "lost"
        if self.failure:
            return "failed"
        if self.done:
            return "trained"
        return "stopped" if self.manifest_path.exists() else "new"

    @property
    def failure(self) -> str | None:
        """Why the run failed, in one line; None if it did not."""
        return read_json(self.folder / "FAILED").get("reason")

    def fail(self, reason: str, details: str = "") -> None:
        """Record why the run failed."""
        write_json(
            self.folder / "FAILED", {"reason": " ".join(reason.split()), "when": now(), "details": details}
        )

    def retry(self) -> None:
        """Forget the failure, and the attempts that led to it."""
        if self.failure:
            self.reset_deaths()
        check_owner(self.folder)
        (self.folder / "FAILED").unlink(missing_ok=True)

    def reset_deaths(self) -> None:
        """Stop counting attempts so far as ones that died: the run ended well, or is to be tried again."""
        manifest = self.manifest
        attempts = len(manifest.get("attempts", []))
        if attempts > manifest.get("forgiven", 0):
            self.write_manifest({"forgiven": attempts})

    def begin(
        self, kind: str, config: Mapping[str, Any], *, data: str, prerequisite: str | None, **facts: Any
    ) -> None:
        """Write config.yaml and the manifest of a run that starts or resumes.

        If the code was changed since its commit, a patch is written beside them.

        Args:
            kind: what is trained (see `Identity`).
            config: the resolved config.
            data: digest of the prepared data.
            prerequisite: id of the run whose weights this one uses.
            facts: further entries of the manifest, such as component versions, device and threads, the
                origins of its prerequisite runs (`prerequisite_runs`), and the user's packages (`plugins`).
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        atomic_write(self.config_path, yaml.safe_dump(dict(config), sort_keys=False, allow_unicode=True))
        if patch := changes():
            atomic_write(self.folder / "code.patch", patch)
        identity = {"id": self.id, "kind": kind, "data": data, "prerequisite": prerequisite}
        before = self.manifest if self.checkpoint.exists() else {}
        sources = describe_sources(facts.get("plugins", ()))
        made = join_origins(before, {**facts, **environment(), **sources})
        self.attempt("training")
        times = {"started": self.manifest.get("started", now()), "finished": None, "seconds": {}}
        self.write_manifest(identity | times | made)

    def record_seconds(self, stage: str, seconds: float) -> None:
        """Record in the manifest the seconds of a stage, summed over all processes that worked on it."""
        known = self.manifest.get("seconds", {})
        self.write_manifest({"seconds": {**known, stage: round(seconds, 3)}})

    def attempt(self, stage: str) -> None:
        """Record that a process begins to work on a stage of the run."""
        self.retry()
        begun = {"started": now(), "pid": os.getpid(), "host": host(), "step": self.step, "stage": stage}
        self.write_manifest({"attempts": [*self.manifest.get("attempts", []), begun]})

    def write_manifest(self, fields: Mapping[str, Any]) -> None:
        """Add fields to the manifest, or replace them.

        Raises:
            InputError: if the manifest that is there can't be read: what it had would be lost.
        """
        known = self.manifest
        if not known and self.manifest_path.exists():
            raise InputError(f"{self.manifest_path}: damaged; remove the run folder to make the run again")
        write_json(self.manifest_path, known | dict(fields))

    @property
    def manifest(self) -> dict[str, Any]:
        """The facts about the run; empty before it began."""
        return read_json(self.manifest_path)

    @property
    def config(self) -> dict[str, Any]:
        """The resolved config; empty before the run began.

        Raises:
            InputError: if the file is damaged.
        """
        try:
            found = copy.deepcopy(_parse(self.config_path.read_text())) if self.config_path.exists() else {}
        except (yaml.YAMLError, UnicodeDecodeError):
            found = None
        if not isinstance(found, dict):
            raise InputError(
                f"{self.config_path}: cannot be read; remove the run folder to make the run again"
            )
        return found

    @property
    def results(self) -> dict[str, Any]:
        """The results with the run's own settings: mode -> branch -> metric, and "latency".

        Where only another file was exported than the config asks for, that is in the latter's name:
        "latency-int8", "latency-naive" (`deployment_shown`).

        A VQ-VAE's run has its own results instead. Where a branch was evaluated by several kinds of inverse
        kinematics, that of the run's config counts, else the last one
        (`evaluations_as_configured.combined_by`); tables ask for an evaluation by its identity.

        Raises:
            InputError: if the file of an evaluation is damaged.
        """
        found = read_json(self.results_path) | self.evaluations_as_configured.results
        config = self.config
        deployed = self.deployment_shown(config)
        return found | ({latency_name(deployed, config): deployed.record} if deployed.record else {})

    @property
    def evaluations_as_configured(self) -> EvaluationsAsConfigured:
        """The evaluations with the settings of the run's config, as they are now."""
        return EvaluationsAsConfigured(self.evaluations, self.config)

    @property
    def changed_sources(self) -> list[str]:
        """The files with code that has changed since the run was made; empty if that is unknown.

        Files of the user's packages are included, if these are found.
        """
        return changed_since(self.manifest)

    def log(self, step: int, values: Mapping[str, float], phase: str = "train") -> None:
        """Append one line to the metrics log, in one write: a kill damages at most that line."""
        self._log.append(step, values, phase)

    @property
    def step(self) -> int:
        """The last logged training step; 0 before the first."""
        return max((entry.step for entry in self.metrics()), default=0)

    def metrics(self) -> list[LogRecord]:
        """Read the metrics log (see `MetricsLog.read`)."""
        return self._log.read()

    def finish(self, artifacts: Sequence[str]) -> None:
        """Mark the run as done: write the marker with the artifacts' digests, last and atomically."""
        finished = now()
        self.write_manifest({"finished": finished})
        digests = {name: file_digest(self.folder / name) for name in artifacts}
        write_json(self.marker, {"id": self.id, "finished": finished, "artifacts": digests})

    @property
    def done(self) -> bool:
        """Whether the run is finished, and the folder does not belong to another run's id."""
        marker = read_json(self.marker)
        return "artifacts" in marker and belongs(marker.get("id"), self.folder)

    @property
    def weights_digest(self) -> str | None:
        """The SHA-256 of the weights as the training left them; None before it is finished."""
        return read_json(self.marker).get("artifacts", {}).get(self.model.name)

    def weights(self) -> Path:
        """Return the file of the trained weights.

        Raises:
            InputError: if the file was changed since the training.
        """
        digest = self.weights_digest
        if digest and not self._same(self.model.name, digest):
            raise InputError(
                f"{self.model}: not the weights that were trained; do the run again with force=true"
            )
        return self.model

    def verify(self) -> list[str]:
        """Return the artifacts of a finished run that are missing or were changed since."""
        artifacts = dict(read_json(self.marker).get("artifacts", {}))
        for latency in sorted(self.deployments.glob("*/latency.json")):
            where = latency.parent.relative_to(self.folder)
            made = read_json(latency).get("artifacts", {})
            artifacts |= {str(where / name): digest for name, digest in made.items()}
        changed = [name for name, digest in artifacts.items() if not self._same(name, digest)]
        reports = sorted(self.evaluations.glob("*.json"))
        return changed + [str(path.relative_to(self.folder)) for path in reports if not intact(path)]

    def _same(self, name: str, digest: str) -> bool:
        path = self.folder / name
        return path.is_file() and file_digest(path) == digest

    def reset(self) -> None:
        """Remove the run's own files, with the marker first, and nothing else."""
        if not self.folder.exists():
            return
        check_owner(self.folder)
        self.marker.unlink(missing_ok=True)
        sync_folder(self.folder)
        self._remove((*self.FILES, self.marker.name))

    def clear_stages(self) -> None:
        """Remove the evaluations and deployments, which belong to earlier weights."""
        self._remove(self.STAGES)

    def _remove(self, names: Iterable[str]) -> None:
        check_owner(self.folder)
        for name in names:
            temporary = str(Path(name).with_name(f".{Path(name).name}.*.tmp"))
            for path in (*self.folder.glob(name), *self.folder.glob(temporary)):
                path.unlink(missing_ok=True)
        for folder in (*self.deployments.glob("*/"), self.evaluations, self.deployments):
            with contextlib.suppress(OSError):  # it does not exist, or holds files of the user's
                folder.rmdir()
        sync_folder(self.folder)
