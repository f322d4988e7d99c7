"""Finished runs made of random numbers, for tests of tables and pages. Nothing was trained."""

from __future__ import annotations

import functools
import hashlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from memmlp.runs.run import Run
from memmlp.sweep.definition import MODES, Arm, Sweep
from memmlp.tables.build_table import finished_runs, make_table
from memmlp.tables.effects import RunsBySeed
from memmlp.tables.measured_run import Measured, load
from memmlp.tables.table import Table

Find = Callable[[Arm, int], Run | None]
BASE = {
    "MPJRE": 4.15, "geodesic": 6.9, "MPJPE": 6.5, "Hand PE": 2.1, "Upper PE": 3.3, "Lower PE": 9.6,
    "Root PE": 5.0, "MPJVE": 38.0, "Jitter": 11.0, "GT Jitter": 7.1,
}  # fmt: skip
NO_POSITIONS = ("MPJRE", "geodesic")
CLIPS = (*(f"salsa/{number:02}" for number in range(1, 11)), "kicks/01", "kicks/02")
ORIGIN = {
    "version": "0.3.0", "git": {"commit": "0123456789abcdef", "dirty": False}, "data": "d" * 64,
    "cpu": "A processor", "cores": 2, "host": "h" * 12, "packages": {"torch": "2.0.0"}, "device": "cpu",
    "threads": 1, "precision": "fp32", "recipes": {"memory": 1}, "body": "builtin",
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
    run = Run.of(outputs, hashlib.sha256(f"{name} {seed}".encode()).hexdigest()[:16])
    run.folder.mkdir(parents=True, exist_ok=True)
    rows = [_clip(clip, seed, factor, run.id, branches) for clip in clips]
    for row in rows if groups else ():
        row["group"] = (groups or {})[row["name"]]
    latency = {
        "median_ms": 0.8 * factor, "p95_ms": 1.1 * factor, "ratio_to_yardstick": 0.6, "parameters": 356_798,
        "macs": 13_000_000, "flops": 26_000_000, "onnx_bytes": 1_900_000,
    }  # fmt: skip
    manifest = {"id": run.id, "kind": "memmlp", "seconds": {"train": 300.0, "evaluate": 20.0}, **ORIGIN}
    manifest |= {"started": "2026-01-02T03:04:05+00:00", **(origin or {})}
    files = {
        run.manifest_path: manifest,
        run.config_path: {"seed": seed, "memory": {"layers": [2, 4]}, **(config or {})},
        run.marker: {"id": run.id, "artifacts": {}},
        run.deployment("fp32-0").latency: latency | {"made": "2026"},
    }
    for path, content in files.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(content))
    for mode in ("window", "stream"):
        clips_of_mode = [
            {key: row[key] for key in ("name", "frames", "group") if key in row} | row[mode] for row in rows
        ]
        mean = _means([row[mode] for row in rows])
        report = {"mode": mode, "settings": {}, "mean": mean, "clips": clips_of_mode, "made_by": manifest}
        path = run.evaluation(f"{mode}-0")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(report | {"made": "2026"} | (evaluated or {})))
    if log:
        _log(run, factor)
    return run


def fake_sweep(
    outputs: Path, sweep: Sweep, effects: Mapping[str, float] | None = None, **settings: Any
) -> Find:
    """Runs of all arms and seeds; `effects` are factors on the errors by label. Returns what finds them."""
    runs = {
        (arm.label, seed): fake_run(
            outputs,
            f"{sweep.name} {arm.label}",
            seed,
            (effects or {}).get(arm.label, 1.0),
            config={"overrides": list(arm.overrides or ())},
            **settings,
        )
        for arm in sweep.runnable()
        for seed in sweep.seeds
    }

    def find(arm: Arm, seed: int) -> Run | None:
        return runs.get((arm.label, seed))

    return find


def runs_of(sweep: Sweep, find: Find, read: Callable[[Path], Measured] = load) -> dict[str, RunsBySeed]:
    """The finished ones of the runs that are found."""

    def measured(arm: Arm, seed: int) -> Measured | None:
        run = find(arm, seed)
        return read(run.folder) if run is not None and run.done else None

    return finished_runs(sweep, measured)


def table_of(sweep: Sweep, find: Find, command: str | None = None, modes: Sequence[str] = MODES) -> Table:
    """The table of the runs that are found."""

    def state(arm: Arm, seed: int) -> str | None:
        run = find(arm, seed)
        return None if run is None or run.done else run.status

    return make_table(sweep, runs_of(sweep, find), modes, command, state)


def nothing(arm: Arm, seed: int) -> None:
    """Finds no run."""


def _draw(*words: object) -> np.random.Generator:
    digest = hashlib.sha256(" ".join(map(str, words)).encode()).digest()
    return np.random.default_rng(int.from_bytes(digest[:8], "big"))


@functools.cache
def _luck(word: str | int) -> float:
    """The same for the same word in every run."""
    return float(_draw(word).normal())


def _clip(clip: str, seed: int, factor: float, name: str, branches: Sequence[str]) -> dict[str, Any]:
    """A row of clips.json: the clip's difficulty and the seed's luck, the same for every run, and noise."""
    level = factor * math.exp(0.2 * _luck(clip) + 0.01 * _luck(seed))
    noise = iter(np.exp(0.01 * _draw(name, clip).normal(size=2 * len(branches) * len(BASE))).tolist())
    row: dict[str, Any] = {"name": clip, "frames": 600}
    for mode, jumps in (("window", 1.3), ("stream", 1.0)):
        row[mode] = {
            branch: {
                metric: round(base * level * (jumps if metric == "Jitter" else 1) * next(noise), 6)
                for metric, base in BASE.items()
                if branch != "position" or metric not in NO_POSITIONS
            }
            for branch in branches
        }
    return row


def _means(rows: Sequence[dict[str, dict[str, float]]]) -> dict[str, dict[str, float]]:
    return {
        branch: {metric: float(np.mean([row[branch][metric] for row in rows])) for metric in values}
        for branch, values in rows[0].items()
    }


def _log(run: Run, factor: float) -> None:
    """A metrics log that falls from far above to the run's level."""
    noise = _draw(run.id)
    for step in range(0, 2001, 100):
        loss = factor * (1 + 4 * np.exp(-step / 300)) * float(np.exp(0.05 * noise.normal()))
        run.log(step, {"loss": loss, "lr": 1e-3})
        if step % 500 == 0:
            run.log(step, {"rotation MPJPE": 6.5 * loss, "rotation MPJRE": 4.1 * loss}, "val")
