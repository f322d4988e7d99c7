"""A sweep with finished runs that are kept, for the tests of kept results and of their pages."""

from __future__ import annotations

from pathlib import Path

import pytest
from fake_runs import CLIPS, fake_sweep, runs_of

from memmlp.report.kept_results import Kept, overrides_of
from memmlp.sweep.definition import Sweep
from memmlp.sweep.sweep_file import load_sweep

ROOT = Path(__file__).parent.parent.parent
GROUPS = {clip: f"take {number // 2}" for number, clip in enumerate(CLIPS)}


@pytest.fixture
def sweep() -> Sweep:
    return load_sweep(ROOT / "sweeps" / "table14.yaml")


@pytest.fixture
def kept(sweep: Sweep, tmp_path: Path) -> Kept:
    find = fake_sweep(tmp_path, sweep, {"2": 1.1, "2, 4": 1.03}, groups=GROUPS)
    return Kept("table14", ("data=mocap",), runs_of(sweep, find), overrides_of(sweep))
