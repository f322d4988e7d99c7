"""The request of a composed config: the ids of its runs and stages, and existing results.

This module does not import torch, so planning a sweep and finding finished runs are fast.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from memmlp.common.components import find_chosen_settings
from memmlp.common.progress import announce, notify
from memmlp.motion.body import FPS
from memmlp.motion.clip import LINES, SkippedFile
from memmlp.motion.motion_source import MotionSource, PreparedMotion
from memmlp.motion.preparing.amass_names import describe_absent_subsets
from memmlp.motion.preparing.groups import describe_divided_folders, describe_unmatched_patterns
from memmlp.motion.preparing.manifest import ClipRecord, Manifest
from memmlp.runs.environment import describe_user_packages
from memmlp.runs.evaluation_file import read_report
from memmlp.runs.identity import NETWORK, VQVAE_SHAPE, Identity, compute_deployment_id, compute_evaluation_id
from memmlp.runs.run import Run

LOW_RATE = 0.99  # of the network's rate; 59.94 Hz counts as 60


@dataclass(frozen=True)
class RunRequest:
    """A run requested by a resolved config, with its prerequisite runs and the stages after its training."""

    config: dict[str, Any]
    motion: MotionSource

    @property
    def outputs(self) -> Path:
        """The folder of runs and caches."""
        return Path(self.config["paths"]["outputs"])

    @property
    def evaluations(self) -> dict[str, str]:
        """The evaluation ids by mode."""
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

    def compute_identities(self, data_digest: str) -> list[Identity]:
        """Return the identities of the required runs in training order; the network's run is the last one."""
        found: list[Identity] = []
        for kind, config in self._run_chain:
            found.append(Identity(kind, config, data_digest, found[-1] if found else None))
        return found

    def identity(self, data_digest: str) -> Identity:
        """Return the identity of the network's run, given the digest of the data."""
        return self.compute_identities(data_digest)[-1]

    @cached_property
    def _run_chain(self) -> list[tuple[str, dict[str, Any]]]:
        """The kind and the identifying config of each required run, in training order. A frozen VQ-VAE's run
        covers its config; of a joint VQ-VAE, only the keys of its architecture count."""
        config, codes = self.config, getattr(find_chosen_settings(self.config, "memory"), "codes", None)
        network_config = {key: value for key, value in config.items() if key != "vqvae"}
        if codes == "joint":
            network_config["vqvae"] = {key: config["vqvae"][key] for key in VQVAE_SHAPE}
        if config.get("imported_weights"):
            return [(NETWORK, network_config)]
        if config["refiner"] is not None:
            bare = remove_refiner(config)
            return [*RunRequest(bare, self.motion)._run_chain, (NETWORK, network_config)]
        prerequisite: Any = find_chosen_settings(config, "prerequisite")
        if prerequisite is not None:
            return [*prerequisite.prerequisites(config), (NETWORK, network_config)]
        if codes == "frozen":
            vqvae = {"normalizer": config["normalizer"], "vqvae": config["vqvae"]}
            vqvae |= {"data": {"mirror": True}} if config["data"].get("mirror") else {}
            return [("vqvae", vqvae), (NETWORK, network_config)]
        return [(NETWORK, network_config)]


def remove_refiner(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the config without refiner, `force` and `save_predictions`."""
    return {**config, "refiner": None, "force": False, "save_predictions": None}


@dataclass(frozen=True)
class Outcome:
    """The result of a request: the network's run, the stages ("training", "evaluation", "deployment") that
    this call ran, the results (mode -> branch -> metric, and "latency"), and the ids of the stages that they
    come from."""

    run: Run
    new_stages: tuple[str, ...]
    results: dict[str, Any]
    stage_ids: tuple[str, ...]


def find_finished_outcome(request: RunRequest) -> Outcome | None:
    """Return a request's outcome if its run and all stages exist; None if work remains."""
    if request.config["force"] or request.config["save_predictions"] or request.motion.find_digest() is None:
        return None
    data = request.motion.prepare()
    run = Run.from_id(request.outputs, request.identity(data.digest).id)
    if not run.done or not all(map(run.has, request.stage_ids)) or list_missing_modes(request, run):
        return None
    announce_data(data)
    with run.lock():
        run.request_stages(request.stage_ids)
    return Outcome(run, (), read_results(request, run), request.stage_ids)


def announce_data(data: PreparedMotion) -> None:
    """Print facts and warnings about the data before a run begins."""
    clips = data.manifest.clips
    announce(f"data: {len(clips)} clips ({describe_test_clips(clips)}), prepared in {data.cache}")
    for text in list_data_remarks(data):
        notify(f"data: {text}")


def list_missing_modes(request: RunRequest, run: Run) -> list[str]:
    """Return the modes to evaluate: missing modes, and modes whose custom metrics have new code, which a
    package may change without a new component version."""
    return [
        mode
        for mode, name in request.evaluations.items()
        if not run.has(name) or _measured_by_other_code(request, read_report(run.evaluation(name)))
    ]


def _measured_by_other_code(request: RunRequest, report: Mapping[str, Any]) -> bool:
    if not (report.get("settings") or {}).get("metrics"):
        return False
    before, now = report.get("plugins") or {}, describe_user_code(request).get("plugins", {})
    return any(before[name]["digest"] != now[name]["digest"] for name in before.keys() & now.keys())


def describe_user_code(request: RunRequest) -> dict[str, Any]:
    """Return version and digest of the user's packages that the config uses; empty without such packages."""
    packages = request.config.get("plugins")
    return {"plugins": describe_user_packages(packages)} if packages else {}


def read_results(request: RunRequest, run: Run) -> dict[str, Any]:
    """Return the requested results: mode -> branch -> metric, and "latency"."""
    files = {mode: run.evaluation(name) for mode, name in request.evaluations.items() if run.has(name)}
    means = {mode: read_report(path)["mean"] for mode, path in files.items()}
    record = run.deployment(request.deployment_id).record if request.deployment_id else {}
    return means | ({"latency": record} if record else {})


def read_clip_rows(request: RunRequest, run: Run) -> list[dict[str, Any]]:
    """Return a row for each test clip: name, frames, and the requested metrics by mode and branch."""
    rows: dict[str, dict[str, Any]] = {}
    for mode, name in request.evaluations.items():
        for clip in read_report(run.evaluation(name))["clips"]:
            facts = {key: value for key, value in clip.items() if not isinstance(value, dict)}
            branches = {key: value for key, value in clip.items() if isinstance(value, dict)}
            rows.setdefault(clip["name"], facts)[mode] = branches
    return list(rows.values())


def list_data_remarks(data: PreparedMotion) -> list[str]:
    """Return the warnings about the data to print before a run begins."""
    manifest = data.manifest
    remarks = (
        describe_skipped_files(manifest.skipped),
        describe_unusual_clips(manifest.unusual),
        describe_low_rates(manifest, manifest.clips, "clips"),
        describe_divided_folders(manifest),
        describe_unmatched_patterns(manifest.split, [clip.name for clip in manifest.clips]),
        None if data.has("val") else "no validation clips, so trainings are not validated (data.split.val)",
    )
    return list(filter(None, remarks))


def describe_test_clips(clips: Sequence[ClipRecord]) -> str:
    """Return the numbers of test clips and groups, with a hint if they are too low for conclusions."""
    tested = [clip.group for clip in clips if clip.split == "test"]
    counts = f"test clips: {len(tested)}, in groups: {len(set(tested))}"
    if len(set(tested)) > 1:
        return counts
    return f"{counts}, too few to compare networks; use more motion or a larger data.split.test"


def describe_low_rates(manifest: Manifest, clips: Sequence[ClipRecord], what: str) -> str | None:
    """Return a remark on linearly interpolated clips with a low frame rate, which makes kinks in the motion,
    or None. `what` names the clips, such as "test clips"."""
    rates = sorted(clip.fps for clip in clips if clip.fps < LOW_RATE * FPS)
    if not rates or manifest.interpolation != LINES:
        return None
    hertz = f"{rates[0]:g}" + (f" to {rates[-1]:g}" if rates[-1] > rates[0] else "")
    slow = f"{len(rates)} of {len(clips)} {what} were recorded at {hertz} Hz"
    return f"{slow} and interpolated linearly (data.interpolation), which raises Jitter and velocity errors"


def describe_skipped_files(skipped: Sequence[SkippedFile]) -> str | None:
    """Return a remark on skipped files; None without skipped files."""
    if not skipped:
        return None
    files = "1 file was" if len(skipped) == 1 else f"{len(skipped)} files were"
    first = skipped[0]
    return f"{files} skipped, first {first.file} ({first.reason}); data.strict=true makes this an error"


def describe_unusual_clips(unusual: Mapping[str, str]) -> str | None:
    """Return a remark on unusual clips, given by name and reason; None without unusual clips."""
    if not unusual:
        return None
    clips = "1 clip is" if len(unusual) == 1 else f"{len(unusual)} clips are"
    first, *others = list(unusual)[:3]
    names = ", ".join([f"{first} ({unusual[first]})", *others])
    return f"{clips} unusual, first {names}; details: memmlp data inspect"


def collect_data_warnings(config: Mapping[str, Any], data: PreparedMotion) -> dict[str, Any]:
    """Return warnings about a run's data by name, for tables; None where a warning does not apply."""
    manifest = data.manifest
    tested = [clip for clip in manifest.clips if clip.split == "test"]
    names = [clip.name for clip in tested if clip.name in manifest.unusual]
    odd = [f"{name} ({manifest.unusual[name]})" for name in names]
    return {
        "partial": describe_missing_data(config, data),
        "divided": describe_divided_folders(manifest) or None,
        "resampled": describe_low_rates(manifest, tested, "test clips"),
        "unusual": f"{len(odd)} of {len(tested)} test clips are unusual, first {odd[0]}" if odd else None,
    }


def describe_missing_data(config: Mapping[str, Any], data: PreparedMotion) -> str | None:
    """Describe missing data of the protocol or of the training groups; None if the data is complete."""
    data_config, manifest = config["data"], data.manifest
    coverage, subsets = manifest.coverage, manifest.listed or (*manifest.left_out, *manifest.groups)
    fraction = data_config["split"].get("train_fraction", 1)
    parts = [] if coverage.is_complete else [str(coverage)]
    parts += [absent] if (absent := describe_absent_subsets(data_config["name"], subsets)) else []
    parts += [f"{100 * fraction:g} % of its training groups"] if fraction < 1 else []
    return ", ".join([data_config["name"], *parts]) if parts else None
