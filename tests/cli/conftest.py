"""Sweeps that need no runs, the tiny run, and clips of random motion."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from fake_runs import CLIPS, fake_sweep

from memmlp.common.errors import InputError
from memmlp.motion.clip import Clip
from memmlp.motion.formats.npz import write_clip
from memmlp.runs.lookup import is_trained, list_runs
from memmlp.runs.run import Run
from memmlp.sweep.definition import Sweep
from memmlp.sweep.plan import Entry, Plan


@pytest.fixture
def planned(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Replace planning: every run of a sweep is there, but none of seed 99. Table 1 can't be planned, and
    Table 10 has no run."""

    def plan(sweep: Sweep, outputs: Path, prepare: bool = False) -> Plan:
        if sweep.table == 1 or "bad=1" in sweep.command_line:
            raise InputError("data.root: has no value")
        find = fake_sweep(tmp_path / sweep.name, sweep, clips=CLIPS[-4:])
        entries = [(variant, seed) for variant in sweep.list_runnable() for seed in sweep.seeds if seed != 99]
        found = [Entry(variant.label, seed, find(variant, seed).id) for variant, seed in entries]
        return Plan(sweep.name, tmp_path / sweep.name, tuple(found) if sweep.table != 10 else (), ())

    replace_planning(monkeypatch, plan)


def replace_planning(monkeypatch: pytest.MonkeyPatch, plan: Callable[..., Plan]) -> None:
    for module in ("sweep", "table"):
        monkeypatch.setattr(f"memmlp.cli.{module}.make_plan", plan)


def find_trained(home: Path) -> Run:
    (run,) = (run for run in list_runs(home / "outputs") if is_trained(run))
    return run


def write_random_clip(path: Path, rng: np.random.Generator) -> None:
    """Write a second and a half of motion."""
    poses = 0.05 * np.cumsum(rng.normal(size=(90, 22, 3)), 0)
    write_clip(path, Clip("", poses, 0.01 * np.cumsum(rng.normal(size=(90, 3)), 0), 60.0))
