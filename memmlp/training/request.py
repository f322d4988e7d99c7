"""What a composed config asks for: its runs and their stages by id, and the results if they exist.

This module needs no torch, so that planning a sweep, listing, and finding a finished run are quick.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from memmlp.common.components import find_chosen_settings
from memmlp.common.progress import announce, notify
from memmlp.motion.body import FPS
from memmlp.motion.clip import LINES, Skipped
from memmlp.motion.motion_source import MotionSource, Prepared
from memmlp.motion.preparing.amass_names import absent_subsets
from memmlp.motion.preparing.groups import divided_remark, unmatched_patterns_remark
from memmlp.motion.preparing.manifest import ClipRecord, Manifest
from memmlp.runs.environment import describe_user_packages
from memmlp.runs.evaluation_file import read_report
from memmlp.runs.identity import NETWORK, VQVAE_SHAPE, Identity, compute_deployment_id, compute_evaluation_id
from memmlp.runs.run import Run

SLOW = 0.99  # of the network's rate; 59.94 Hz counts as 60


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
        return {
            mode: compute_evaluation_id(self.config, mode, groups)
            for mode in self.config["evaluation"]["modes"]
        }

    @property
    def deployment_id(self) -> str | None:
        """The id of the deployment; None if the network is not deployed."""
        return None if self.config["export"]["graph"] == "off" else compute_deployment_id(self.config)

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
        prerequisite: Any = find_chosen_settings(config, "prerequisite")
        if prerequisite is not None:
            return [*prerequisite.prerequisites(config), (NETWORK, own)]
        if codes == "frozen":
            vqvae = {"normalizer": config["normalizer"], "vqvae": config["vqvae"]}
            vqvae |= {"data": {"mirror": True}} if config["data"].get("mirror") else {}
            return [("vqvae", vqvae), (NETWORK, own)]
        return [(NETWORK, own)]


def codes_of(config: Mapping[str, Any]) -> str | None:
    """Return how the VQ-VAE of a config's memory is trained, "frozen" or "joint"; None without one."""
    return getattr(find_chosen_settings(config, "memory"), "codes", None) or None


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
    run = Run.from_id(request.outputs, request.identity(data.digest).id)
    if not run.done or not all(map(run.has, request.stage_ids)) or unmeasured(request, run):
        return None
    announce_data(data)
    with run.lock():
        run.request_stages(request.stage_ids)
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
    return {"plugins": describe_user_packages(packages)} if packages else {}


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


def data_remarks(data: Prepared) -> list[str]:
    """Return what the user should know of the data before a run begins."""
    manifest = data.manifest
    found = (
        skipped_remark(manifest.skipped),
        unusual_remark(manifest.unusual),
        low_rates_remark(manifest, manifest.clips, "clips"),
        divided_remark(manifest),
        unmatched_patterns_remark(manifest.split, [clip.name for clip in manifest.clips]),
    )
    return list(filter(None, found))


def tested_clips_remark(clips: Sequence[ClipRecord]) -> str:
    """Say how many test clips and groups there are, and whether they are too few for conclusions."""
    tested = [clip.group for clip in clips if clip.split == "test"]
    counts = f"test clips: {len(tested)}, in groups: {len(set(tested))}"
    if len(set(tested)) > 1:
        return counts
    return f"{counts}, too few to compare networks; use more motion or a larger data.split.test"


def low_rates_remark(manifest: Manifest, clips: Sequence[ClipRecord], what: str) -> str | None:
    """Return a remark on clips with a low frame rate that were interpolated linearly; None without any.

    Linear interpolation makes kinks in the motion.

    Args:
        manifest: the data's manifest.
        clips: some or all of its clips.
        what: their name in the plural.
    """
    rates = sorted(clip.fps for clip in clips if clip.fps < SLOW * FPS)
    if not rates or manifest.interpolation != LINES:
        return None
    hertz = f"{rates[0]:g}" + (f" to {rates[-1]:g}" if rates[-1] > rates[0] else "")
    slow = f"{len(rates)} of {len(clips)} {what} were recorded at {hertz} Hz"
    return f"{slow} and are interpolated linearly (data.interpolation): the kinks enter Jitter and velocities"


def skipped_remark(skipped: Sequence[Skipped]) -> str | None:
    """Return a remark on skipped files; None without any."""
    if not skipped:
        return None
    files = "1 file was" if len(skipped) == 1 else f"{len(skipped)} files were"
    first = skipped[0]
    return f"{files} skipped, first {first.file} ({first.reason}); data.strict=true stops there"


def unusual_remark(unusual: Mapping[str, str]) -> str | None:
    """Return a remark on clips that are unusual but may be correct (name -> why); None without any."""
    if not unusual:
        return None
    clips = "1 clip is" if len(unusual) == 1 else f"{len(unusual)} clips are"
    first, *others = list(unusual)[:3]
    names = ", ".join([f"{first} ({unusual[first]})", *others])
    return f"{clips} unusual, first {names}; details: memmlp data inspect"


def data_warnings(config: Mapping[str, Any], data: Prepared) -> dict[str, Any]:
    """Return warnings about a run's data for tables to flag, in words; None for each that does not apply.

    Args:
        config: the run's config.
        data: its prepared data.
    """
    manifest = data.manifest
    tested = [clip for clip in manifest.clips if clip.split == "test"]
    names = [clip.name for clip in tested if clip.name in manifest.unusual]
    odd = [f"{name} ({manifest.unusual[name]})" for name in names]
    return {
        "partial": partial_words(config, data),
        "divided": divided_remark(manifest) or None,
        "resampled": low_rates_remark(manifest, tested, "test clips"),
        "unusual": f"{len(odd)} of {len(tested)} test clips are unusual, first {odd[0]}" if odd else None,
    }


def partial_words(config: Mapping[str, Any], data: Prepared) -> str | None:
    """Describe what the data lacks of its protocol or of its training clips; None if it is complete."""
    own, manifest = config["data"], data.manifest
    coverage, found = manifest.coverage, manifest.listed or (*manifest.left_out, *manifest.groups)
    fraction = own["split"].get("train_fraction", 1)
    parts = [] if coverage.whole else [str(coverage)]
    parts += [absent] if (absent := absent_subsets(own["name"], found)) else []
    parts += [f"{100 * fraction:g} % of its training groups"] if fraction < 1 else []
    return ", ".join([own["name"], *parts]) if parts else None
