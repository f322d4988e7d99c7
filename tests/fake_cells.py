"""Finished runs in the cells of a sweep's axes, made of random numbers, whose effect has a known course."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from fake_runs import CLIPS, fake_sweep, runs_of

from memmlp.sweep.definition import Sweep
from memmlp.sweep.sweep_file import parse_sweep
from memmlp.tables.effects import RunsBySeed

STEPS = (500, 1000, 2000, 4000, 8000)
GROUPS = {clip: f"take {number // 2}" for number, clip in enumerate(CLIPS)}
STEP = 1e9  # FLOPs


def content(**changes: Any) -> dict[str, Any]:
    """The content of a sweep file with a line of cells, and one with less data."""
    return {
        "title": "Memory with more steps",
        "seeds": [0, 1],
        "metrics": ["MPJPE", "Jitter"],
        "arms": {"full": [], "none": {"overrides": ["memory=none"], "against": "full"}},
        "axes": [
            {"optim.steps": list(STEPS), "data.split.train_fraction": [1.0]},
            {"optim.steps": [2000], "data.split.train_fraction": [0.5, 0.25]},
        ],
        "scale": {"along": ["compute", "data.split.train_fraction"], "predict": ["profile=paper"]},
        **changes,
    }


def steps_of(cell: tuple[str, ...]) -> int:
    return int(dict(word.split("=") for word in cell)["optim.steps"])


def cells(
    folder: Path, factor: Callable[[int], float], **changes: Any
) -> tuple[Sweep, dict[str, RunsBySeed]]:
    """A sweep and its runs; without the memory errors are `factor(steps)` times as large."""
    sweep = parse_sweep("cells", content(**changes))
    effects = {arm.label: factor(steps_of(arm.cell)) for arm in sweep.arms if arm.series == "none"}
    runs = runs_of(sweep, fake_sweep(folder, sweep, effects, groups=GROUPS))
    return sweep, {arm.label: trained(runs[arm.label], steps_of(arm.cell)) for arm in sweep.arms}


def trained(runs: RunsBySeed, steps: int) -> Mapping[int, Any]:
    """The runs with the FLOPs of so many steps."""
    return {
        seed: replace(run, training={**run.training, "flops": STEP * steps}) for seed, run in runs.items()
    }
