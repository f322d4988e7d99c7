"""A sweep with finished runs that are kept, for the tests of kept results and of their pages."""

from pathlib import Path

import pytest
from fake_runs import CLIPS, Find, fake_sweep, runs_of

from memmlp.report.kept_results import KeptResults, list_overrides
from memmlp.sweep.definition import Sweep
from memmlp.sweep.sweep_file import load_sweep

ROOT = Path(__file__).parent.parent.parent
GROUPS = {clip: f"take {number // 2}" for number, clip in enumerate(CLIPS)}


@pytest.fixture
def sweep() -> Sweep:
    return load_sweep(ROOT / "sweeps" / "table14.yaml")


@pytest.fixture(scope="session")
def find(tmp_path_factory: pytest.TempPathFactory) -> Find:
    """What finds the sweep's runs, which hold still."""
    sweep = load_sweep(ROOT / "sweeps" / "table14.yaml")
    return fake_sweep(tmp_path_factory.mktemp("kept"), sweep, {"2": 1.1, "2, 4": 1.03}, groups=GROUPS)


@pytest.fixture
def kept(sweep: Sweep, find: Find) -> KeptResults:
    return KeptResults("table14", ("data=mocap",), runs_of(sweep, find), list_overrides(sweep))
