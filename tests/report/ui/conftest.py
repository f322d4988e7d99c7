"""Run folders of invented numbers, a sweep of them, and servers on them."""

import json
from pathlib import Path

import numpy as np
import pytest
from fake_runs import fake_run

from memmlp.runs.run import Run
from memmlp.sweep.definition import Sweep, save_sweep_copy
from memmlp.sweep.plan import Entry, Plan, RunTask
from memmlp.sweep.sweep_file import parse_sweep

FRAMES = 900
VARIANTS = {"none": 1.0, "gru": 0.8}
SEEDS = (0, 1, 2)


@pytest.fixture
def outputs(tmp_path: Path) -> Path:
    make_outputs(tmp_path / "outputs")
    return tmp_path / "outputs"


def make_outputs(outputs: Path) -> Sweep:
    """Make a finished sweep called "mine" of invented runs."""
    variants = {
        variant: {"overrides": [f"memory={variant}"], "paper": {"MPJPE": 6 * factor}}
        for variant, factor in VARIANTS.items()
    }
    sweep = parse_sweep(
        "mine", {"title": "Mine", "seeds": list(SEEDS), "variants": variants, "metrics": ["MPJPE"]}
    )
    entries, tasks = [], []
    for variant, factor in VARIANTS.items():
        for seed in SEEDS:
            optim = {"steps": 2000, "batch": 1, "lr": 1e-3}  # which is little motion
            config = {"memory": {"name": variant}, "seed": seed, "optim": optim, "model": {"frames": 11}}
            name = {"name": f"memory={variant} · seed {seed}"}
            run = fake_run(outputs, variant, seed, factor, config=config, origin=name, log=True)
            entries.append(Entry(variant, seed, run.id))
            tasks.append(RunTask(run.id, "memmlp", config))
    folder = outputs / "sweeps" / "mine"
    Plan("mine", outputs, tuple(entries), tuple(tasks)).save(folder / "plan.json")
    save_sweep_copy(sweep, folder)
    return sweep


def run_of(outputs: Path, variant: str = "gru", seed: int = 0) -> Run:
    plan = Plan.load(outputs / "sweeps" / "mine" / "plan.json")
    found = plan.run(variant, seed)
    assert found is not None
    return found


def started_run(outputs: Path, name: str = "abcdef0123456789", step: int = 500) -> Run:
    """Make a run that trains: no marker, a log as far as a step."""
    run = Run.from_id(outputs, name)
    run.folder.mkdir(parents=True)
    run.config_path.write_text("memory:\n  name: lstm\nseed: 7\noptim:\n  steps: 2000\n")
    run.manifest_path.write_text(
        json.dumps({"id": name, "kind": "memmlp", "started": "2026-01-02T03:04:05+00:00"})
    )
    for at in range(0, step + 1, 100):
        run.log(at, {"loss": 5 - at / 1000})
    return run


def motion(at: int = 300, centimetres: float = 20.0) -> dict[str, np.ndarray]:
    """Truth and a prediction that is off by so much in one second, and by a centimetre elsewhere."""
    truth = np.zeros((FRAMES, 22, 3))
    truth[..., 2] = 1.0
    off = np.full(FRAMES, 0.01)
    off[at : at + 60] = centimetres / 100
    predicted = truth.copy()
    predicted[..., 0] += off[:, None]
    return {"true_positions": truth, "predicted_positions": predicted}


def predict(run: Run, clip: str, mode: str) -> dict[str, np.ndarray]:
    return motion(300 if clip == "kicks/01" else 120, 20.0 if run.config["memory"]["name"] == "gru" else 10.0)
