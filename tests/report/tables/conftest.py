"""A sweep and its table for the tests of tables."""

from pathlib import Path

import pytest
from fake_runs import fake_sweep, table_of
from fake_table import EFFECTS, FILE

from memmlp.report.tables.table import Table
from memmlp.sweep.definition import Sweep
from memmlp.sweep.sweep_file import parse_sweep


@pytest.fixture
def sweep() -> Sweep:
    return parse_sweep("table11", FILE)


@pytest.fixture
def table(sweep: Sweep, tmp_path: Path) -> Table:
    return table_of(sweep, fake_sweep(tmp_path, sweep, EFFECTS))
