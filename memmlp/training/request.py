"""What a composed config asks for: its runs and their stages by id, and the results if they exist.

This module needs no torch, so that planning a sweep, listing, and finding a finished run are quick.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from memmlp.common.components import chosen
from memmlp.common.progress import announce, notify
from memmlp.motion.motion_source import MotionSource, Prepared
from memmlp.runs.environment import user_packages
from memmlp.runs.evaluation_file import read_report
from memmlp.runs.identity import NETWORK, VQVAE_SHAPE, Identity, deployment_id, evaluation_id
from memmlp.runs.run import Run
from memmlp.training.data_remarks import data_remarks, tested_clips_remark


@dataclass(frozen=True)
class RunRequest:
    """A run that a config asks for, with the runs that it builds upon and the stages after its training.

    Attributes:
        config: the resolved config.
        motion: the source of the motion.
    """

    config: dict[str, Any]
    motion: MotionSource

    @property
    def outputs(self) -> Path:
        """The folder of runs and caches."""
        return Path(self.config["paths"]["outputs"])

    @property
    def evaluations(self) -> dict[str, str]:
        """The id of the evaluation, by mode."""
        groups = self.motion.groups_digest
        return {mode: evaluation_id(self.config, mode, groups) for mode in self.config["evaluation"]["modes"]}

    @property
    def deployment_id(self) -> str | None:
        """The id of the deployment; None if the network is not deployed."""
        return None if self.config["export"]["graph"] == "off" else deployment_id(self.config)

    @property
    def stage_ids(self) -> tuple[str, ...]:
        """The ids of the stages after training: the evaluations and the deployment."""
        return (*self.evaluations.values(), *([self.deployment_id] if self.deployment_id else []))

    def identities(self, data_digest: str) -> list[Identity]:
        """Return the identities of the runs that are needed, in order, the network's own run last."""
        found: list[Identity] = []
        for kind, config in self._chain:
            found.append(Identity(kind, config, data_digest, found[-1] if found else None))
        return found

    def identity(self, data_digest: str) -> Identity:
        """Return the identity of the network's run, given the digest of the data."""
        return self.identities(data_digest)[-1]

    @cached_property
    def _chain(self) -> list[tuple[str, dict[str, Any]]]:
        """The runs that are needed, in order: their kinds, and the configs that determine their results.

        The identity of a frozen VQ-VAE's run covers its config. A joint VQ-VAE is trained with the network:
        only the keys of its architecture have an effect.
        """
        config, codes = self.config, codes_of(self.config)
        own = {key: value for key, value in config.items() if key != "vqvae"}
        if codes == "joint":
            own["vqvae"] = {key: config["vqvae"][key] for key in VQVAE_SHAPE}
        if config["refiner"] is not None:
            bare = without_refiner(config)
            return [*RunRequest(bare, self.motion)._chain, (NETWORK, own)]
        prerequisite: Any = chosen(config, "prerequisite")
        if prerequisite is not None:
            return [*prerequisite.prerequisites(config), (NETWORK, own)]
        if codes == "frozen":
            vqvae = {"normalizer": config["normalizer"], "vqvae": config["vqvae"]}
            vqvae |= {"data": {"mirror": True}} if config["data"].get("mirror") else {}
            return [("vqvae", vqvae), (NETWORK, own)]
        return [(NETWORK, own)]


def codes_of(config: Mapping[str, Any]) -> str | None:
    """Return how the VQ-VAE of a config's memory is trained, "frozen" or "joint"; None without one."""
    return getattr(chosen(config, "memory"), "codes", None) or None


def without_refiner(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the config of the same network without its refiner, not forced and without saved predictions."""
    return {**config, "refiner": None, "force": False, "save_predictions": None}


@dataclass(frozen=True)
class Outcome:
    """The result of a request.

    Attributes:
        run: the network's run.
        made: the stages that this call made, out of "training", "evaluation" and "deployment".
        results: mode -> branch -> metric, and "latency".
        stage_ids: the ids of the evaluations and the deployment that the results come from.
    """

    run: Run
    made: tuple[str, ...]
    results: dict[str, Any]
    stage_ids: tuple[str, ...]


def finished_outcome(request: RunRequest) -> Outcome | None:
    """Return the outcome of a request whose run and stages all exist; None if there is something to do."""
    if request.config["force"] or request.config["save_predictions"] or request.motion.digest() is None:
        return None
    data = request.motion.prepare()
    run = Run.of(request.outputs, request.identity(data.digest).id)
    if not run.done or not all(map(run.has, request.stage_ids)) or unmeasured(request, run):
        return None
    announce_data(data)
    with run.lock():
        run.want(request.stage_ids)
    return Outcome(run, (), results_of(request, run), request.stage_ids)


def announce_data(data: Prepared) -> None:
    """Print what the user should know of the data before a run begins."""
    clips = data.manifest.clips
    announce(f"data: {len(clips)} clips ({tested_clips_remark(clips)}), prepared in {data.cache}")
    for text in data_remarks(data):
        notify(f"data: {text}")


def unmeasured(request: RunRequest, run: Run) -> list[str]:
    """Return the modes without an evaluation, or with one by other code of the user's own metrics.

    A package's code may change without a new component version; then its metrics are measured again.
    """
    return [
        mode
        for mode, name in request.evaluations.items()
        if not run.has(name) or _measured_by_other_code(request, read_report(run.evaluation(name)))
    ]


def _measured_by_other_code(request: RunRequest, report: Mapping[str, Any]) -> bool:
    if not (report.get("settings") or {}).get("metrics"):
        return False
    before, now = report.get("plugins") or {}, own_code(request).get("plugins", {})
    return any(before[name]["digest"] != now[name]["digest"] for name in before.keys() & now.keys())


def own_code(request: RunRequest) -> dict[str, Any]:
    """Return version and digest of the user's packages that the config uses; empty if it uses none."""
    packages = request.config.get("plugins")
    return {"plugins": user_packages(packages)} if packages else {}


def results_of(request: RunRequest, run: Run) -> dict[str, Any]:
    """Return the results that the request asks for: mode -> branch -> metric, and "latency"."""
    files = {mode: run.evaluation(name) for mode, name in request.evaluations.items() if run.has(name)}
    means = {mode: read_report(path)["mean"] for mode, path in files.items()}
    record = run.deployment(request.deployment_id).record if request.deployment_id else {}
    return means | ({"latency": record} if record else {})


def clip_rows(request: RunRequest, run: Run) -> list[dict[str, Any]]:
    """Return name, frames and the wanted metrics, by mode and branch, for each test clip."""
    rows: dict[str, dict[str, Any]] = {}
    for mode, name in request.evaluations.items():
        for clip in read_report(run.evaluation(name))["clips"]:
            facts = {key: value for key, value in clip.items() if not isinstance(value, dict)}
            branches = {key: value for key, value in clip.items() if isinstance(value, dict)}
            rows.setdefault(clip["name"], facts)[mode] = branches
    return list(rows.values())
