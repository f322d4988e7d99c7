"""Reads the results of a finished run from its folder."""

from __future__ import annotations

import hashlib
import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from memmlp.common.errors import InputError
from memmlp.common.processes import MIN_CORE_FRACTION
from memmlp.evaluation.metric_facts import MIN_FRAMES
from memmlp.motion.preparing.groups import Grouping
from memmlp.runs import records
from memmlp.runs.deployment_folder import (
    describe_timing_machine,
    find_deployed_precision,
    select_deployed_measurements,
)
from memmlp.runs.environment import collect_prerequisite_versions, get_recorded_prerequisites
from memmlp.runs.evaluation_file import is_intact, keep_one_solver, read_report
from memmlp.runs.lookup import count_training_frames
from memmlp.runs.run import Run
from memmlp.sweep.definition import TIMES

Errors = Mapping[str, Mapping[str, Mapping[str, Any]]]  # values by mode, branch and metric
UNKNOWN = "?"
SHARED_METRIC = "MPJPE"  # a metric of both branches
CORE_FRACTION_KEYS = {
    "core share": "core_share",
    "network core share": "alone_core_share",
    "pose core share": "pose_core_share",
}
"""Core shares: the fraction of a timed period in which the thread had a core, for a step, the network and a
pose. Keys are names of a run's costs, values are keys of a deployment's record. Old runs lack some."""
SAME_ERROR_TOLERANCE = 1e-4  # maximum relative difference between equal errors (float32)


@dataclass(frozen=True)
class Origin:
    """The code, data and machine of a run. All runs of a table should have the same origin.

    Code, uncommitted changes, packages and machines cover prerequisites and evaluations too.

    Attributes:
        code: the commit; outside a checkout, the package's version.
        changed: whether the checkout had uncommitted changes.
        data: a digest of the prepared data.
        hardware: the processor.
        device: "cpu", "cuda" or "mps".
        gpu: the GPU's name.
        threads: the number of torch threads on the processor.
        processes: the number of training processes.
        torch: the version of torch.
        precision: the training precision.
        body: the body with the rest joints: "builtin" or the file of a body model.
        component_versions: the version of each component.
        prerequisite: the id of the prerequisite run, such as a VQ-VAE; None without one.
        prerequisite_versions: the known component versions of the prerequisite runs.
        prerequisite_weights: a digest of the weights by prerequisite run id, if known. If the run was resumed
            with other weights, the text has two digests.
        partial: a warning if part of the protocol's clip list is missing; None otherwise.
        plugins: version and code digest of each custom package.
        offline: whether the network uses future frames, so it can't run as a stream.
        deployed: the precision of the exported file; size and times are measured with this file.
        timed_on: the processor and the ONNX Runtime version of the time measurements.
        divided: a warning if subjects have clips in both training and test; None otherwise.
        resampled: a warning if test clips were recorded at a lower rate; None otherwise.
        unusual: a warning if test clips are unusual; None otherwise.
        imported: the origin of imported weights; None for a training.
    """

    code: str
    changed: bool
    data: str
    hardware: str
    device: str = UNKNOWN
    gpu: str = UNKNOWN
    threads: str = UNKNOWN
    processes: str = "1"
    torch: str = UNKNOWN
    precision: str = UNKNOWN
    body: str = UNKNOWN
    component_versions: Mapping[str, int] = field(default_factory=dict)
    prerequisite: str | None = None
    partial: str | None = None
    plugins: Mapping[str, str] = field(default_factory=dict)
    offline: bool = False
    deployed: str = "fp32"
    timed_on: str = UNKNOWN
    divided: str | None = None
    resampled: str | None = None
    unusual: str | None = None
    imported: str | None = None
    prerequisite_versions: Mapping[str, int] = field(default_factory=dict)
    prerequisite_weights: Mapping[str, str] = field(default_factory=dict)

    @property
    def every_version(self) -> Mapping[str, int]:
        """The version of each component, including components of prerequisite runs."""
        return {**self.prerequisite_versions, **self.component_versions}


@dataclass(frozen=True)
class MeasuredRun:
    """The results of a finished run.

    Attributes:
        id: the run's id.
        means: mean metrics over the test clips.
        clips: metrics by clip name.
        groups: the group (take, subject) of each clip; an unlisted clip forms a separate group.
        costs: GFLOP and GMAC of the trained network for one frame; for the exported file, ms per step, ratio
            to the yardstick's time in the same minute, millions of parameters, MB, frames per second and
            core shares (CORE_FRACTION_KEYS).
        origin: the code, data and machine.
        clip_sources: the source of each clip, if the data has several sources.
        run: the run's folder; None for kept results.
        training: known training costs: `seconds`; `frames`, the total number of frames in all training
            windows; `tflop`, the compute with prerequisite runs; `budget`, the compute that `optim.tflop`
            asks for.
        code: code digests by file (`compute_code_digests`), joined with different digests of prerequisite
            runs; empty for kept results.
        clips_are_groups: whether each clip is the mean of a group (`average_groups`).
    """

    id: str
    means: Errors
    clips: Mapping[str, Errors]
    groups: Mapping[str, str]
    costs: Mapping[str, float]
    origin: Origin
    run: Run | None = None
    clip_sources: Mapping[str, str] = field(default_factory=dict)
    training: Mapping[str, float] = field(default_factory=dict)
    code: Mapping[str, str] = field(default_factory=dict)
    clips_are_groups: bool = False

    def get_value(self, mode: str, branch: str, metric: str) -> float | None:
        """Return a metric's mean over clips, or a cost; None if it was not measured."""
        if metric in self.costs:
            return self.costs[metric]
        found = self.means.get(mode, {}).get(branch, {}).get(metric)
        return None if found is None else float(found)  # files store NaN as text

    def get_clip_values(self, names: Sequence[str], mode: str, branch: str, metric: str) -> np.ndarray:
        """Return a metric for the named clips (C,); NaN for clips without a value."""
        clips = self.clips
        try:
            found = [clips[name][mode][branch][metric] for name in names]
        except KeyError:
            found = [clips[name].get(mode, {}).get(branch, {}).get(metric) for name in names]
        return np.array(found, float)  # None becomes NaN

    def count_clips(self, mode: str, branch: str, metric: str) -> tuple[int, int]:
        """Return the number of clips with a value for a metric, and the number of all clips."""
        known = np.isfinite(self.get_clip_values(list(self.clips), mode, branch, metric))
        return int(known.sum()), len(known)

    def get_group(self, clip: str) -> str:
        """Return a clip's group; an unlisted clip forms a separate group."""
        return self.groups.get(clip, clip)

    def group_clips(self, patterns: Sequence[str]) -> MeasuredRun:
        """Return the results with merged groups: clips with equal matches of a pattern share a group.

        Args:
            patterns: regular expressions, as in `data.split.groups`.
        """
        grouping = Grouping(tuple(patterns), {clip: self.get_group(clip) for clip in self.clips})
        groups = grouping.group_clips({clip: clip for clip in self.clips})
        return replace(self, groups={clip: group[0] for group in groups for clip in group})

    def average_groups(self) -> MeasuredRun:
        """Return the results with the means of each group of clips as one clip."""
        members: dict[str, list[str]] = {}
        for clip in self.clips:
            members.setdefault(self.get_group(clip), []).append(clip)
        means = {group: self.restrict_to_clips(clips).means for group, clips in sorted(members.items())}
        averaged = replace(self, clips=means, groups={}, clip_sources={}, clips_are_groups=True)
        return averaged.restrict_to_clips(list(means))

    def split_by_source(self) -> dict[str, MeasuredRun]:
        """Return the results by source, each restricted to the source's clips; empty for a single source."""
        own: dict[str, list[str]] = {name: [] for name in sorted(set(self.clip_sources.values()))}
        for clip in self.clips if own else ():
            own[self.clip_sources[clip]].append(clip)
        return {name: self.restrict_to_clips(clips) for name, clips in own.items()}

    def restrict_to_clips(self, clips: Sequence[str]) -> MeasuredRun:
        """Return the results on the given clips, with means over these clips."""
        means = {
            mode: {
                branch: _average_clips(
                    {metric: self.get_clip_values(clips, mode, branch, metric) for metric in metrics}
                )
                for branch, metrics in branches.items()
            }
            for mode, branches in self.means.items()
        }
        return replace(self, clips={clip: self.clips[clip] for clip in clips}, means=means)

    def has_branch(self, branch: str) -> bool:
        """Return whether the run was evaluated in the given branch."""
        return any(branch in branches for branches in self.means.values())

    def get_branch_means(self, branch: str) -> dict[str, Any]:
        """Return the means in the given branch, by mode."""
        return {mode: branches.get(branch) for mode, branches in self.means.items()}

    @property
    def has_one_branch(self) -> bool:
        """Whether the network predicts only rotations, judged by its errors.

        Then forward kinematics computes the positions, and both branches have equal errors. Clips on which
        the network diverged are ignored.
        """
        names, branches = list(self.clips), ("rotation", "position")
        modes = [mode for mode, known in self.means.items() if all(branch in known for branch in branches)]
        for mode in modes:
            one, other = (self.get_clip_values(names, mode, branch, SHARED_METRIC) for branch in branches)
            known = np.isfinite(one + other)
            if not math.isclose(one[known].sum(), other[known].sum(), rel_tol=SAME_ERROR_TOLERANCE):
                return False
        return True


def _average_clips(values: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Return the mean of each metric over clips (C,), like the evaluation (`modes.evaluate`).

    A mean excludes clips that are too short for the metric (MIN_FRAMES). Other missing values make it NaN.
    If the network diverged on a clip, all means are NaN. SHARED_METRIC shows this, because it has a number
    even for the shortest clip.
    """
    diverged = SHARED_METRIC in values and bool(np.isnan(values[SHARED_METRIC]).any())
    known = {m: each[~np.isnan(each)] if m in MIN_FRAMES else each for m, each in values.items()}
    return {m: float(each.mean()) if len(each) and not diverged else math.nan for m, each in known.items()}


def load_measured_run(folder: Path, stages: Sequence[str] | None = None) -> MeasuredRun:
    """Read a finished run.

    Args:
        folder: the run's folder.
        stages: ids of the evaluations and the deployment to read. By default, or if none of these exists,
            the run's config selects evaluations and deployment.

    Raises:
        InputError: if a file is damaged.
    """
    run = Run(folder)
    run.check_records()
    manifest = records.load(run.manifest_path, records.Manifest)
    means, clips = dict[str, dict[str, Any]](), dict[str, dict[str, Any]]()
    groups, sources = dict[str, str](), dict[str, str]()
    wanted = [path for name in stages or () if (path := run.evaluation(name)).is_file()]
    paths = wanted or run.configured_evaluations.paths
    reports = keep_one_solver(list(map(_read_intact_report, paths)))
    for report in reports:
        _merge_report(means.setdefault(report["mode"], {}), report["mean"])
        for clip in report["clips"]:
            _merge_report(clips.setdefault(clip["name"], {}).setdefault(report["mode"], {}), clip)
            groups |= {clip["name"]: clip["group"]} if clip.get("group") else {}
            sources |= {clip["name"]: clip["source"]} if clip.get("source") else {}
    deployments = [run.deployment(name) for name in stages or () if run.deployment(name).done]
    deployed = (deployments or [run.find_shown_deployment(run.config)])[-1]
    latency = deployed.record
    origin = _add_evaluations(_join_prerequisite_origins(_read_origin(manifest), run), reports)
    origin = replace(
        origin,
        deployed=find_deployed_precision(latency),
        component_versions={**origin.component_versions, **deployed.component_versions},
        timed_on=describe_timing_machine(latency),
    )
    known = {
        "seconds": (manifest.get("seconds") or {}).get("train"),
        "frames": count_training_frames(run) or None,
        "tflop": manifest.get("tflop"),
        "budget": (run.config.get("optim") or {}).get("tflop"),
    }
    training = {name: float(value) for name, value in known.items() if value is not None}
    costs, code = _read_costs(latency), _read_code_digests(manifest)
    return MeasuredRun(run.id, means, clips, groups, costs, origin, run, sources, training, code)


def measure_untrained(
    overrides: Sequence[str], record: Mapping[str, Any], environment: Mapping[str, Any]
) -> MeasuredRun:
    """Return the costs of an untrained network; its id is a digest of the overrides.

    Args:
        overrides: the overrides that define the network.
        record: sizes and times, in the format of a deployment's record.
        environment: code, packages and hardware, in the format of a run's manifest.
    """
    digest = hashlib.sha256("\n".join(["untrained", *overrides]).encode()).hexdigest()[:16]
    return MeasuredRun(digest, {}, {}, {}, _read_costs(record), _read_origin(environment))


def _merge_report(merged: dict[str, Any], report: Mapping[str, Any]) -> None:
    """Merge a report into earlier reports in place. Reports may have different branches."""
    for name, value in report.items():
        merged[name] = {**merged.get(name, {}), **value} if isinstance(value, Mapping) else value


def _read_intact_report(path: Path) -> dict[str, Any]:
    report = read_report(path)
    if not is_intact(path):
        raise InputError(
            f"{path}: changed since it was written, or of another run or evaluation; "
            "remove it and repeat the run's command to evaluate again"
        )
    return report


def _read_costs(latency: Mapping[str, Any]) -> dict[str, float]:
    """Return the measured costs in the units of the tables.

    Size and times refer to the file in the configured precision. "network ms" is always float32.
    """
    measured = select_deployed_measurements(latency)

    def get_cost(name: str) -> float:
        return float(measured.get(name, np.nan))

    costs = {
        "FLOPs": get_cost("flops") / 1e9,
        "MACs": get_cost("macs") / 1e9,
        "parameters": get_cost("parameters") / 1e6,
        "size": get_cost("onnx_bytes") / 1e6,
        "ms": get_cost("median_ms"),
        "network ms": get_cost("alone_median_ms"),
        "pose ms": get_cost("pose_median_ms"),
        "ratio": get_cost("ratio_to_yardstick"),
        "FPS": 1000 / get_cost("median_ms"),
        **{name: get_cost(key) for name, key in CORE_FRACTION_KEYS.items()},
    }
    return {name: float(cost) for name, cost in costs.items() if not np.isnan(cost)}


def _read_origin(manifest: Mapping[str, Any]) -> Origin:

    def get_text(key: str) -> str:
        return str(manifest.get(key) or UNKNOWN)

    git = manifest.get("git") or {}
    # If a training was resumed with other code, its first commit is listed too.
    before = [git["before"][:7]] if git.get("before") else []
    texts = ("device", "gpu", "threads", "precision", "body")
    facts = ("prerequisite", "partial", "divided", "resampled", "unusual")
    copied: dict[str, Any] = {name: get_text(name) for name in texts}
    copied |= {name: manifest.get(name) for name in facts}
    imported = manifest.get("imported") or {}
    return Origin(
        code=", ".join([*before, git["commit"][:7]]) if git else f"version {get_text('version')}",
        changed=bool(git.get("dirty")),
        data=get_text("data")[:8],
        hardware=get_text("cpu"),
        processes=str(manifest.get("processes") or 1),
        imported=f"{imported['file']} of {imported['source']}" if imported else None,
        torch=str((manifest.get("packages") or {}).get("torch") or UNKNOWN),
        component_versions=manifest.get("component_versions") or {},
        **copied,
        plugins={
            name: f"{one['version'] or 'no version'} ({one['digest']})"
            for name, one in (manifest.get("plugins") or {}).items()
        },
    )


def _read_code_digests(manifest: Mapping[str, Any]) -> dict[str, str]:
    own, *others = [one.get("sources") or {} for one in (manifest, *get_recorded_prerequisites(manifest))]
    return {name: _join_unique([own[name], *(one[name] for one in others if name in one)]) for name in own}


def _join_prerequisite_origins(origin: Origin, run: Run) -> Origin:
    prerequisite = get_recorded_prerequisites(run.manifest)
    digests: dict[str, list[str]] = defaultdict(list)
    for one in prerequisite:
        digests[one["id"]] += [one["weights"][:8]] if one.get("weights") else []
    weights = {name: _join_unique(found) for name, found in digests.items() if found}
    joined = join_origins(origin, list(map(_read_origin, prerequisite)))
    return replace(
        joined,
        prerequisite_versions=collect_prerequisite_versions(run.manifest),
        prerequisite_weights=weights,
    )


def _add_evaluations(origin: Origin, reports: Sequence[Mapping[str, Any]]) -> Origin:
    others = [_read_origin({**report.get("made_by", {}), **report}) for report in reports]
    versions = {name: number for one in (origin, *others) for name, number in one.component_versions.items()}
    offline = any(report.get("offline") for report in reports)
    return replace(join_origins(origin, others), component_versions=versions, offline=offline)


def join_origins(origin: Origin, others: Sequence[Origin]) -> Origin:
    """Return an origin with the code, machines, packages and plugins of others."""
    every = [origin, *others]
    found: dict[str, Any] = {"changed": any(one.changed for one in every)}
    for name in ("code", "hardware", "device", "gpu", "threads", "torch"):
        known = [word for other in others if (word := getattr(other, name)) not in (UNKNOWN, "version ?")]
        found[name] = _join_unique([getattr(origin, name), *known])
    names = dict.fromkeys(name for one in every for name in one.plugins)
    plugins = {
        name: _join_unique(one.plugins[name] for one in every if name in one.plugins) for name in names
    }
    return replace(origin, **found, plugins=plugins)


def _join_unique(parts: Iterable[str]) -> str:
    """Join texts with commas, without repetitions. A text may itself be a comma-separated list."""
    return ", ".join(dict.fromkeys(word for part in parts for word in part.split(", ")))


def find_core_fraction(run: MeasuredRun) -> float | None:
    """Return the fraction of the time in which a core ran a run's timed thread; None if unknown.

    With several measurements, the smallest fraction counts.
    """
    return min((run.costs[name] for name in CORE_FRACTION_KEYS if name in run.costs), default=None)


def select_undisturbed_runs(runs: Mapping[int, MeasuredRun]) -> Mapping[int, MeasuredRun]:
    """Return the runs that were timed with a core for their thread; all runs if there are no such runs.

    A time does not depend on the seed, so undisturbed measurements are better than a mean over all runs.
    """
    alone = {seed: run for seed, run in runs.items() if (find_core_fraction(run) or 0) >= MIN_CORE_FRACTION}
    return alone or runs


def select_runs_for_metric(metric: str, runs: Mapping[int, MeasuredRun]) -> Mapping[int, MeasuredRun]:
    """Return the runs that count for a metric: undisturbed runs for a time, all runs otherwise."""
    return select_undisturbed_runs(runs) if metric in TIMES else runs
