"""What a finished run has to say to a table."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from memmlp.errors import InputError
from memmlp.runs import Run

Errors = Mapping[str, Mapping[str, Mapping[str, Any]]]  # mode -> branch -> metric -> value
UNKNOWN = "?"


@dataclass(frozen=True)
class Origin:
    """What a run was made from and on; runs of one table should agree in it.

    Attributes:
        code: commit, or the version where there is no checkout. changed: whether it had uncommitted changes.
        data: digest of the prepared data. body: whose rest joints the motion is on ("built-in", "SMPL-H").
        hardware: the processor. device: "cpu" or "cuda"; gpu: its name. threads: of torch on the processor.
        torch: its version. precision: of training.
        recipes: number of the recipe by component. vqvae: id of the VQ-VAE's run, where there is one.
    """

    code: str
    changed: bool
    data: str
    hardware: str
    device: str = UNKNOWN
    gpu: str = UNKNOWN
    threads: str = UNKNOWN
    torch: str = UNKNOWN
    precision: str = UNKNOWN
    body: str = UNKNOWN
    recipes: Mapping[str, int] = field(default_factory=dict)
    vqvae: str | None = None


@dataclass(frozen=True)
class Measured:
    """The results of a finished run.

    Attributes:
        id: of the run.
        means: the metrics' means over the test clips. clips: those of each clip by its name.
        groups: the group (take, subject) of each clip; a clip that is not named is a group of its own.
        costs: GFLOP, GMAC and ms of a streaming step, its time over the reference network's in the same
            minute, millions of parameters, MB of ONNX, frames a second.
        origin: what the run was made from.
        latency: all that was measured of its streaming step.
        run: the folder where it lies; None where it was read from results that were kept without one.
    """

    id: str
    means: Errors
    clips: Mapping[str, Errors]
    groups: Mapping[str, str]
    costs: Mapping[str, float]
    origin: Origin
    latency: Mapping[str, Any] = field(default_factory=dict)
    run: Run | None = None

    def value(self, mode: str, branch: str, metric: str) -> float | None:
        """A metric's mean over clips, or a cost; None where the run has none."""
        if metric in self.costs:
            return self.costs[metric]
        return _number(self.means, mode, branch, metric)

    def by_clip(self, names: Sequence[str], mode: str, branch: str, metric: str) -> np.ndarray:
        """A metric of these clips (C,); NaN where the run has none."""
        numbers = [_number(self.clips[name], mode, branch, metric) for name in names]
        return np.array([np.nan if number is None else number for number in numbers])

    def group(self, clip: str) -> str:
        """The group of a clip."""
        return self.groups.get(clip, clip)

    def has(self, branch: str) -> bool:
        """Whether the network was evaluated in that branch."""
        return any(branch in branches for branches in self.means.values())


def load(folder: Path) -> Measured:
    """Read a finished run. Raises InputError, naming the file that is damaged."""
    run = Run(folder)
    results, manifest = _read(run.results_path, dict), _read(run.manifest_path, dict)
    rows = _read(run.clips, list)
    if not all(isinstance(row, dict) and "name" in row for row in rows):
        raise _unreadable(run.clips)
    latency = results.get("latency", {})
    return Measured(
        id=run.id,
        means={mode: results[mode] for mode in ("window", "stream") if mode in results},
        clips={row["name"]: row for row in rows},
        groups={row["name"]: row["group"] for row in rows if row.get("group")},
        costs=_costs(latency),
        origin=_origin(manifest),
        latency=latency,
        run=run,
    )


def _read(path: Path, kind: type) -> Any:
    try:
        content = json.loads(path.read_bytes())
    except (OSError, ValueError):
        content = None
    if not isinstance(content, kind):
        raise _unreadable(path)
    return content


def _unreadable(path: Path) -> InputError:
    return InputError(f"{path}: cannot be read; do the run again with force=true, or remove its folder")


def _costs(latency: Mapping[str, float]) -> dict[str, float]:
    """The costs that the measurement has, in the tables' units."""

    def of(name: str) -> float:
        return float(latency.get(name, np.nan))

    costs = {
        "FLOPs": of("flops") / 1e9,
        "MACs": of("macs") / 1e9,
        "parameters": of("parameters") / 1e6,
        "size": of("onnx_bytes") / 1e6,
        "ms": of("median_ms"),
        "ratio": of("ratio_to_reference"),
        "FPS": 1000 / of("median_ms"),
    }
    return {name: float(cost) for name, cost in costs.items() if not np.isnan(cost)}


def _origin(manifest: Mapping[str, Any]) -> Origin:
    def of(key: str) -> str:
        return str(manifest.get(key) or UNKNOWN)

    git = manifest.get("git") or {}
    return Origin(
        code=git["commit"][:7] if git else f"version {of('version')}",
        changed=bool(git.get("dirty")),
        data=of("data")[:8],
        hardware=of("cpu"),
        device=of("device"),
        gpu=of("gpu"),
        threads=of("threads"),
        torch=str((manifest.get("packages") or {}).get("torch") or UNKNOWN),
        precision=of("precision"),
        body=of("body"),
        recipes=manifest.get("recipes") or {},
        vqvae=manifest.get("upstream"),
    )


def _number(errors: Errors, mode: str, branch: str, metric: str) -> float | None:
    """A value of nested errors; files hold NaN as a word."""
    value = errors.get(mode, {}).get(branch, {}).get(metric)
    return None if value is None else float(value)
