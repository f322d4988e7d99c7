"""Finished runs of random numbers, for tests of tables and pages."""

import functools
import hashlib
import json
import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from memmlp.report.tables.build_table import find_finished_runs, make_table
from memmlp.report.tables.effects import RunsBySeed
from memmlp.report.tables.measured_run import MeasuredRun, load_measured_run
from memmlp.report.tables.table import Table
from memmlp.runs.run import Run
from memmlp.sweep.definition import MODES, Sweep, Variant

Find = Callable[[Variant, int], Run | None]
BASE = {
    "MPJRE": 4.15, "geodesic": 6.9, "MPJPE": 6.5, "Hand PE": 2.1, "Upper PE": 3.3, "Lower PE": 9.6,
    "Root PE": 5.0, "MPJVE": 38.0, "Jitter": 11.0, "GT Jitter": 7.1,
}  # fmt: skip
NO_POSITIONS = ("MPJRE", "geodesic")
CLIPS = (*(f"salsa/{number:02}" for number in range(1, 11)), "kicks/01", "kicks/02")
ORIGIN = {
    "version": "0.3.0", "git": {"commit": "0123456789abcdef", "dirty": False}, "data": "d" * 64,
    "cpu": "A processor", "cores": 2, "host": "h" * 12, "packages": {"torch": "2.0.0"}, "device": "cpu",
    "threads": 1, "precision": "fp32", "component_versions": {"memory": 1}, "body": "builtin",
}  # fmt: skip


def fake_run(
    outputs: Path,
    name: str,
    seed: int = 0,
    factor: float = 1.0,
    clips: Sequence[str] = CLIPS,
    branches: Sequence[str] = ("rotation", "position", "combined"),
    origin: Mapping[str, Any] | None = None,
    evaluated: Mapping[str, Any] | None = None,
    config: Mapping[str, Any] | None = None,
    log: bool = False,
    groups: Mapping[str, str] | None = None,
) -> Run:
    """A finished run whose errors are `factor` times the usual ones, with effects of seed, clip and both."""
    run = Run.from_id(outputs, hashlib.sha256(f"{name} {seed}".encode()).hexdigest()[:16])
    latency = {
        "median_ms": 0.8 * factor, "p95_ms": 1.1 * factor, "ratio_to_yardstick": 0.6, "parameters": 356_798,
        "macs": 13_000_000, "flops": 26_000_000, "onnx_bytes": 1_900_000,
    }  # fmt: skip
    manifest = {"id": run.id, "kind": "memmlp", "seconds": {"train": 300.0, "evaluate": 20.0}, **ORIGIN}
    manifest |= {"started": "2026-01-02T03:04:05+00:00", **(origin or {})}
    deployment = run.deployment("fp32-0")
    for folder in (run.folder, run.evaluations, deployment.folder):
        os.makedirs(folder, exist_ok=True)
    files = {
        run.manifest_path: manifest,
        run.config_path: {"seed": seed, "memory": {"layers": [2, 4]}, **(config or {})},
        run.marker: {"id": run.id, "artifacts": {}},
        deployment.latency: latency | {"made": "2026"},
    }
    for path, content in files.items():
        path.write_text(json.dumps(name_infinities(content)))
    of_clips = tuple((clip, groups[clip] if groups else None) for clip in clips)
    about = {"settings": {}, "made_by": manifest, "made": "2026"} | (evaluated or {})
    words = json.dumps(about)[1:]
    for mode, errors in _errors(run.id, seed, factor, of_clips, tuple(branches)).items():
        write_evaluation(run.evaluation(f"{mode}-0"), json.loads(f"{errors[:-1]}, {words}"))
    if log:
        run.metrics_path.write_text(_log(run.id, factor))
    return run


def fake_sweep(
    outputs: Path, sweep: Sweep, effects: Mapping[str, float] | None = None, **settings: Any
) -> Find:
    """Runs of all variants and seeds; `effects` are factors on the errors by label. Returns a finder."""
    runs = {
        (variant.label, seed): fake_run(
            outputs,
            f"{sweep.name} {variant.label}",
            seed,
            (effects or {}).get(variant.label, 1.0),
            config={"overrides": list(variant.overrides or ())},
            **settings,
        )
        for variant in sweep.list_runnable()
        for seed in sweep.seeds
    }

    def find(variant: Variant, seed: int) -> Run | None:
        return runs.get((variant.label, seed))

    return find


def runs_of(
    sweep: Sweep, find: Find, read: Callable[[Path], MeasuredRun] = load_measured_run
) -> dict[str, RunsBySeed]:
    def measured(variant: Variant, seed: int) -> MeasuredRun | None:
        run = find(variant, seed)
        return read(run.folder) if run is not None and run.done else None

    return find_finished_runs(sweep, measured)


def table_of(sweep: Sweep, find: Find, command: str | None = None, modes: Sequence[str] = MODES) -> Table:
    def state(variant: Variant, seed: int) -> str | None:
        run = find(variant, seed)
        return None if run is None or run.done else run.status

    return make_table(sweep, runs_of(sweep, find), modes, command, state)


def digest_json(content: Mapping[str, Any]) -> str:
    """The digest of an evaluation file, computed apart from the project's code."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def name_infinities(content: Mapping[str, Any]) -> Any:
    """Content with "nan" and "inf" for numbers that JSON does not have, as the project stores them."""
    return json.loads(
        json.dumps(content), parse_constant=lambda name: name.replace("Infinity", "inf").lower()
    )


def write_evaluation(path: Path, report: Mapping[str, Any]) -> None:
    """Write an evaluation file with a new digest."""
    content = name_infinities({key: value for key, value in report.items() if key != "digest"})
    path.write_text(json.dumps(content | {"digest": digest_json(content)}))


def nothing(variant: Variant, seed: int) -> None:
    """A finder without runs."""


def _draw(*words: object) -> np.random.Generator:
    digest = hashlib.sha256(" ".join(map(str, words)).encode()).digest()
    return np.random.default_rng(int.from_bytes(digest[:8], "big"))


@functools.cache
def _luck(word: str | int) -> float:
    """The same number for the same word in every run."""
    return float(_draw(word).normal())


@functools.lru_cache(maxsize=1024)
def _errors(
    name: str, seed: int, factor: float, clips: tuple[tuple[str, str | None], ...], branches: tuple[str, ...]
) -> dict[str, str]:
    """The errors in a run's evaluations by mode, given the names of clips and of their groups."""
    rows = {clip: _clip(clip, seed, factor, name, branches) for clip, _ in clips}
    found = {}
    for mode in ("window", "stream"):
        of_mode = [
            {"name": clip, "frames": 600, **({"group": group} if group else {}), **rows[clip][mode]}
            for clip, group in clips
        ]
        mean = _means([rows[clip][mode] for clip, _ in clips])
        found[mode] = json.dumps({"mode": mode, "mean": mean, "clips": of_mode})
    return found


def _clip(clip: str, seed: int, factor: float, name: str, branches: Sequence[str]) -> dict[str, Any]:
    """A clip's errors by mode: its difficulty and the seed's luck, the same for every run, and noise."""
    level = factor * math.exp(0.2 * _luck(clip) + 0.01 * _luck(seed))
    noise = iter(np.exp(0.01 * _draw(name, clip).normal(size=2 * len(branches) * len(BASE))).tolist())
    return {
        mode: {
            branch: {
                metric: round(base * level * (jumps if metric == "Jitter" else 1) * next(noise), 6)
                for metric, base in BASE.items()
                if branch != "position" or metric not in NO_POSITIONS
            }
            for branch in branches
        }
        for mode, jumps in (("window", 1.3), ("stream", 1.0))
    }


def _means(rows: Sequence[dict[str, dict[str, float]]]) -> dict[str, dict[str, float]]:
    means = {}
    for branch, metrics in rows[0].items():
        values = np.array([[row[branch][metric] for row in rows] for metric in metrics])
        means[branch] = dict(zip(metrics, values.mean(1).tolist(), strict=True))
    return means


def _log(name: str, factor: float) -> str:
    """A metrics log that falls from far above to the run's level, as `Run.log` writes it."""
    noise, about, lines = _draw(name), {"time": round(time.time(), 3)}, []
    for step in range(0, 2001, 100):
        loss = float(factor * (1 + 4 * np.exp(-step / 300)) * float(np.exp(0.05 * noise.normal())))
        lines.append({"step": step, "phase": "train", **about, "values": {"loss": loss, "lr": 1e-3}})
        if step % 500 == 0:
            errors = {"rotation MPJPE": 6.5 * loss, "rotation MPJRE": 4.1 * loss}
            lines.append({"step": step, "phase": "val", **about, "values": errors})
    return "".join(f"{json.dumps(line)}\n" for line in lines)
