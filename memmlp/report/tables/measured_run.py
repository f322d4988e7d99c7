"""The results of a finished run, read from its folder for tables."""

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
from memmlp.common.files import read_json
from memmlp.common.processes import MIN_CORE_SHARE
from memmlp.motion.preparing.groups import Grouping
from memmlp.runs.deployment_folder import (
    describe_timing_machine,
    find_deployed_precision,
    select_deployed_measurements,
)
from memmlp.runs.environment import collect_prerequisite_versions, get_recorded_prerequisites
from memmlp.runs.evaluation_file import is_intact, keep_one_solver
from memmlp.runs.lookup import count_training_frames
from memmlp.runs.run import Run
from memmlp.sweep.definition import TIMES

Errors = Mapping[str, Mapping[str, Mapping[str, Any]]]  # values by mode, branch and metric
UNKNOWN = "?"
SHARED = "MPJPE"  # a metric that both branches have
CORE_SHARES = {
    "core share": "core_share",
    "network core share": "alone_core_share",
    "pose core share": "pose_core_share",
}
"""The shares of the measured times, of a step, of the network alone and of a pose, in which the thread had a
core: their names among a run's costs, and in a deployment's record. Earlier runs lack some."""
SAME = 1e-4  # relative difference up to which two errors count as those of the same joints (float32)


@dataclass(frozen=True)
class Origin:
    """What a run was made from, and on which machine. All runs of a table should have the same origin.

    Code, uncommitted changes, packages and machines include those of its prerequisites and its evaluations.

    Attributes:
        code: the commit; the package's version outside a checkout.
        changed: whether the checkout had uncommitted changes.
        data: the digest of the prepared data.
        hardware: the processor of training and evaluations.
        device: "cpu", "cuda" or "mps".
        gpu: the GPU's name.
        threads: torch's threads on the processor.
        processes: how many processes trained it together.
        torch: torch's version.
        precision: the precision of training.
        body: whose rest joints the motion is on: "builtin" or the file of a body model.
        component_versions: the version of each component.
        prerequisite: the id of the prerequisite run, such as a VQ-VAE's; None if it is missing.
        prerequisite_versions: the version of each component of the prerequisite runs, as far as known.
        prerequisite_weights: a digest of the weights of each prerequisite run, by its id, if known; two if
            the run was resumed upon others.
        partial: which part of its protocol's list the data is, in words; None if it is complete.
        plugins: version and code digest of each user's package that it uses.
        offline: whether frames are made with later ones, so that it can't run as a stream.
        deployed: the precision of the exported file that was measured for size and times.
        timed_on: the processor on which size and times were measured, and ONNX Runtime's version there.
        divided: a warning, in words, if subjects have clips in both training and test; None otherwise.
        resampled: a warning, in words, if test clips were recorded at a lower rate; None otherwise.
        unusual: a warning, in words, if test clips are odd; None otherwise.
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
    prerequisite_versions: Mapping[str, int] = field(default_factory=dict)
    prerequisite_weights: Mapping[str, str] = field(default_factory=dict)

    @property
    def every_version(self) -> Mapping[str, int]:
        """The component version of each component, of the prerequisite runs too."""
        return {**self.prerequisite_versions, **self.component_versions}


@dataclass(frozen=True)
class Measured:
    """The results of a finished run.

    Attributes:
        id: the run's id.
        means: the metrics' means over the test clips.
        clips: the metrics of each clip, by its name.
        groups: the group (take, subject) of each clip; a clip that is not listed is a group of its own.
        costs: GFLOP and GMAC of the network as it was trained, for one frame; ms of a step of the exported
            graph, the ratio of its time to the yardstick's in the same minute, millions of parameters, MB of
            the ONNX file, frames per second, and the shares of the measured times in which the thread had a
            core (CORE_SHARES).
        origin: what the run was made from.
        clip_sources: the source of each clip, if the data has several sources.
        run: the run's folder; None for results that were kept without it.
        training: what its training took, as far as known: `seconds`; `frames`, the frames seen, each counted
            as often as it was drawn in a window; and `flops` for kept results.
        code: a digest of the code of each file with which it was trained (`code_digests`), or several where
            its prerequisite runs were trained with other code; empty for kept results.
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

    def value(self, mode: str, branch: str, metric: str) -> float | None:
        """Return a metric's mean over clips, or a cost; None if it was not measured."""
        if metric in self.costs:
            return self.costs[metric]
        found = self.means.get(mode, {}).get(branch, {}).get(metric)
        return None if found is None else float(found)  # files hold NaN as a word

    def by_clip(self, names: Sequence[str], mode: str, branch: str, metric: str) -> np.ndarray:
        """Return a metric for each of these clips (C,); NaN for clips that the run did not measure."""
        clips = self.clips
        try:
            found = [clips[name][mode][branch][metric] for name in names]
        except KeyError:
            found = [clips[name].get(mode, {}).get(branch, {}).get(metric) for name in names]
        return np.array(found, float)  # None becomes NaN

    def group(self, clip: str) -> str:
        """Return the group of a clip."""
        return self.groups.get(clip, clip)

    def together(self, patterns: Sequence[str]) -> Measured:
        """Return the same results with clips in one group, too, whose names match a pattern alike.

        Args:
            patterns: regular expressions, as those of `data.split.groups`.
        """
        grouping = Grouping(tuple(patterns), {clip: self.group(clip) for clip in self.clips})
        groups = grouping.tie({clip: clip for clip in self.clips})
        return replace(self, groups={clip: group[0] for group in groups for clip in group})

    def by_source(self) -> dict[str, Measured]:
        """Return the results on each source's clips alone, by source; empty if there is only one source."""
        own: dict[str, list[str]] = {name: [] for name in sorted(set(self.clip_sources.values()))}
        for clip in self.clips if own else ():
            own[self.clip_sources[clip]].append(clip)
        return {name: self.over(clips) for name, clips in own.items()}

    def over(self, clips: Sequence[str]) -> Measured:
        """Return the same results restricted to some clips, with the means over these."""
        means = {
            mode: {
                branch: _means({metric: self.by_clip(clips, mode, branch, metric) for metric in metrics})
                for branch, metrics in branches.items()
            }
            for mode, branches in self.means.items()
        }
        return replace(self, clips={clip: self.clips[clip] for clip in clips}, means=means)

    def has(self, branch: str) -> bool:
        """Return whether the run was evaluated in the given branch."""
        return any(branch in branches for branches in self.means.values())

    def shown(self, branch: str) -> dict[str, Any]:
        """Return the means in the given branch, by mode."""
        return {mode: branches.get(branch) for mode, branches in self.means.items()}

    @property
    def one_branch(self) -> bool:
        """Whether the network predicts rotations alone.

        Its positions then follow from the rotations by forward kinematics, so both branches have the same
        errors. Clips on which the network diverged tell nothing about that.
        """
        names, branches = list(self.clips), ("rotation", "position")
        modes = [mode for mode, known in self.means.items() if all(branch in known for branch in branches)]
        sides = ([self.by_clip(names, mode, branch, SHARED) for branch in branches] for mode in modes)
        known = ((one, other, np.isfinite(one + other)) for one, other in sides)
        return all(math.isclose(one[has].sum(), other[has].sum(), rel_tol=SAME) for one, other, has in known)


def _means(values: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Return the means over clips (C,) of a branch's metrics, as the evaluation does (`modes.evaluate`).

    A clip that is too short for a metric is left out of its mean. A clip for which the network returned NaN
    is not: all means are then NaN. Such a clip is recognised by the metric that has a number even for the
    shortest clip.
    """
    diverged = SHARED in values and bool(np.isnan(values[SHARED]).any())
    known = {metric: each[~np.isnan(each)] for metric, each in values.items()}
    return {m: float(each.mean()) if len(each) and not diverged else math.nan for m, each in known.items()}


def load(folder: Path, stages: Sequence[str] | None = None) -> Measured:
    """Read a finished run.

    Args:
        folder: the run's folder.
        stages: identities of the evaluations and the deployment to read. By default, or if none of these
            exist, all evaluations that use the network as the run's own config does, and the deployment that
            the run shows (`Run.find_shown_deployment`).

    Raises:
        InputError: if a file is damaged; the message names it.
    """
    run = Run(folder)
    manifest = _read(run.manifest_path)
    means: dict[str, dict[str, Any]] = {}
    clips: dict[str, dict[str, Any]] = {}
    groups: dict[str, str] = {}
    sources: dict[str, str] = {}
    wanted = [path for name in stages or () if (path := run.evaluation(name)).is_file()]
    paths = wanted or run.evaluations_as_configured.paths
    reports = keep_one_solver(list(map(_read, paths)))
    for report in reports:
        _join(means.setdefault(report["mode"], {}), report["mean"])
        for clip in report["clips"]:
            _join(clips.setdefault(clip["name"], {}).setdefault(report["mode"], {}), clip)
            groups |= {clip["name"]: clip["group"]} if clip.get("group") else {}
            sources |= {clip["name"]: clip["source"]} if clip.get("source") else {}
    deployments = [run.deployment(name) for name in stages or () if run.deployment(name).done]
    deployed = (deployments or [run.deployment_as_configured])[-1]
    latency = deployed.record
    origin = _evaluated(_with_prerequisites(_origin(manifest), run), reports)
    origin = replace(origin, deployed=find_deployed_precision(latency))
    origin = replace(
        origin,
        component_versions={**origin.component_versions, **deployed.component_versions},
        timed_on=describe_timing_machine(latency),
    )
    seconds, frames = (manifest.get("seconds") or {}).get("train"), count_training_frames(run)
    training = {"seconds": float(seconds)} if seconds is not None else {}
    training |= {"frames": frames} if frames else {}
    costs, code = _costs(latency), _code(manifest)
    return Measured(run.id, means, clips, groups, costs, origin, run, sources, training, code)


def measure_untrained(
    overrides: Sequence[str], record: Mapping[str, Any], environment: Mapping[str, Any]
) -> Measured:
    """Return the costs of a network that was not trained, whose id is a digest of its overrides.

    Args:
        overrides: what the network was made with.
        record: the network's sizes and times, as a deployment records them.
        environment: the code, the packages and the hardware, as a run's manifest has them.
    """
    digest = hashlib.sha256("\n".join(["untrained", *overrides]).encode()).hexdigest()[:16]
    return Measured(digest, {}, {}, {}, _costs(record), _origin(environment))


def _join(known: dict[str, Any], more: Mapping[str, Any]) -> None:
    """Merge a report into known ones: its facts, and the errors of its branches, which others may lack."""
    for name, value in more.items():
        known[name] = {**known.get(name, {}), **value} if isinstance(value, Mapping) else value


def _read(path: Path) -> dict[str, Any]:
    content = read_json(path)
    if not content or ("digest" in content and not is_intact(path)):
        raise InputError(f"{path}: cannot be read; do the run again with force=true, or remove its folder")
    return content


def _costs(latency: Mapping[str, Any]) -> dict[str, float]:
    """Return the costs that were measured, in the units of the tables.

    Size and times are those of the file in the precision that was asked for; the network alone is timed in
    float32 only.
    """
    measured = select_deployed_measurements(latency)

    def of(name: str) -> float:
        return float(measured.get(name, np.nan))

    costs = {
        "FLOPs": of("flops") / 1e9,
        "MACs": of("macs") / 1e9,
        "parameters": of("parameters") / 1e6,
        "size": of("onnx_bytes") / 1e6,
        "ms": of("median_ms"),
        "network ms": of("alone_median_ms"),
        "pose ms": of("pose_median_ms"),
        "ratio": of("ratio_to_yardstick"),
        "FPS": 1000 / of("median_ms"),
        **{name: of(key) for name, key in CORE_SHARES.items()},
    }
    return {name: float(cost) for name, cost in costs.items() if not np.isnan(cost)}


def _origin(manifest: Mapping[str, Any]) -> Origin:

    def of(key: str) -> str:
        return str(manifest.get(key) or UNKNOWN)

    git = manifest.get("git") or {}
    # A training that other code resumed names the commit that it began with, too.
    before = [git["before"][:7]] if git.get("before") else []
    copied: dict[str, Any] = {name: of(name) for name in ("device", "gpu", "threads", "precision", "body")}
    for name in ("prerequisite", "partial", "divided", "resampled", "unusual"):
        copied[name] = manifest.get(name)
    return Origin(
        code=", ".join([*before, git["commit"][:7]]) if git else f"version {of('version')}",
        changed=bool(git.get("dirty")),
        data=of("data")[:8],
        hardware=of("cpu"),
        processes=str(manifest.get("processes") or 1),
        torch=str((manifest.get("packages") or {}).get("torch") or UNKNOWN),
        component_versions=manifest.get("component_versions") or {},
        **copied,
        plugins={
            name: f"{one['version'] or 'no version'} ({one['digest']})"
            for name, one in (manifest.get("plugins") or {}).items()
        },
    )


def _code(manifest: Mapping[str, Any]) -> dict[str, str]:
    own, *others = [one.get("sources") or {} for one in (manifest, *get_recorded_prerequisites(manifest))]
    return {name: _words([own[name], *(one[name] for one in others if name in one)]) for name in own}


def _with_prerequisites(origin: Origin, run: Run) -> Origin:
    prerequisite = get_recorded_prerequisites(run.manifest)
    digests: dict[str, list[str]] = defaultdict(list)
    for one in prerequisite:
        digests[one["id"]] += [one["weights"][:8]] if one.get("weights") else []
    weights = {name: _words(found) for name, found in digests.items() if found}
    joined = _joined(origin, list(map(_origin, prerequisite)))
    return replace(
        joined,
        prerequisite_versions=collect_prerequisite_versions(run.manifest),
        prerequisite_weights=weights,
    )


def _evaluated(origin: Origin, reports: Sequence[Mapping[str, Any]]) -> Origin:
    others = [_origin({**report.get("made_by", {}), **report}) for report in reports]
    versions = {name: number for one in (origin, *others) for name, number in one.component_versions.items()}
    offline = any(report.get("offline") for report in reports)
    return replace(_joined(origin, others), component_versions=versions, offline=offline)


def _joined(origin: Origin, others: Sequence[Origin]) -> Origin:
    found: dict[str, Any] = {"changed": origin.changed or any(other.changed for other in others)}
    for name in ("code", "hardware", "device", "gpu", "threads", "torch"):
        known = [word for other in others if (word := getattr(other, name)) not in (UNKNOWN, "version ?")]
        found[name] = _words([getattr(origin, name), *known])
    plugins = dict(origin.plugins)
    for other in others:
        plugins = _both(plugins, other.plugins)
    return replace(origin, **found, plugins=plugins)


def _words(parts: Iterable[str]) -> str:
    """Join words with commas, each once; a part may be several joined words."""
    return ", ".join(dict.fromkeys(word for part in parts for word in part.split(", ")))


def _both(known: Mapping[str, str], more: Mapping[str, str]) -> dict[str, str]:
    words = {name: dict.fromkeys([*([known[name]] if name in known else []), more[name]]) for name in more}
    return {**known, **{name: ", ".join(each) for name, each in words.items()}}


def find_core_share(run: Measured) -> float | None:
    """Return the least share of a run's measured times in which the thread had a core; None if unknown."""
    return min((run.costs[name] for name in CORE_SHARES if name in run.costs), default=None)


def select_undisturbed(runs: Mapping[int, Measured]) -> Mapping[int, Measured]:
    """Return the runs whose thread had a core while it was timed; all of them if that is known of none.

    A time does not depend on the seed, so one undisturbed measurement says more than a mean with others.
    """
    alone = {seed: run for seed, run in runs.items() if (find_core_share(run) or 0) >= MIN_CORE_SHARE}
    return alone or runs


def select_measured(metric: str, runs: Mapping[int, Measured]) -> Mapping[int, Measured]:
    """Return the runs whose values of a metric count: of a time the undisturbed ones, else every run."""
    return select_undisturbed(runs) if metric in TIMES else runs
