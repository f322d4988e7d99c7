"""`memmlp bench calibration` simulates what it says, and reports promises that are broken."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from memmlp.cli.bench import verdict_simulation
from memmlp.cli.bench.verdict_simulation import (
    SHARES,
    GridRow,
    Shares,
    Simulated,
    broken,
    draw,
    grid,
    simulate,
)
from memmlp.common.files import read_json
from memmlp.statistics.crossed import error


def test_the_grid_is_all_that_have_two_groups():
    assert len(grid()) == 40
    assert GridRow(3, 10, 10) not in grid()
    assert GridRow(10, 536, 10) in grid()
    assert [cell.capped for cell in (GridRow(2, 40, 1), GridRow(3, 4, 1), GridRow(3, 10, 2))] == [
        False,
        False,
        True,
    ]


@pytest.mark.parametrize("cell", [GridRow(5, 10, 1), GridRow(5, 11, 2)])
def test_mixtures_are_those_of_whole_differences(cell: GridRow):
    sample = Simulated(np.random.default_rng(3), cell, 24)
    rng = np.random.default_rng(3)
    of_seeds = np.sqrt(cell.seeds) * rng.normal(size=(24, cell.seeds))
    fixed, noise, _ = draw(rng, cell, 24)
    shares = Shares(1, 2, 3, 4, 5)
    weights = np.sqrt(np.array(shares) / 15)
    by_group = weights[0] * of_seeds[:, :, None] + weights[4] * noise
    by_group = by_group + np.einsum("i,kig->kg", weights[1:4], fixed)[:, None]
    differences = by_group[:, :, cell.groups]
    for seeds in (3, 5):
        known, mean = sample.mixed(shares, seeds)
        expected = error(differences[:, :seeds], cell.groups)
        np.testing.assert_allclose(known.variances, expected.variances)
        assert (known.seeds, known.groups) == (expected.seeds, expected.groups)
        np.testing.assert_allclose(mean, differences[:, :seeds].mean((1, 2)))


@pytest.mark.parametrize("name", SHARES)
def test_means_have_a_variance_of_one(name: str):
    sample = Simulated(np.random.default_rng(0), GridRow(3, 11, 2), 24000)
    known, mean = sample.mixed(SHARES[name], 3)
    assert mean.var() == pytest.approx(1, abs=0.06)
    a, b, e = known.variances.mean(1)
    assert a + b - e == pytest.approx(1, abs=0.06 if SHARES[name].groups else 0.2)


def test_a_cell_is_the_same_again_and_another_with_another_seed():
    cell = GridRow(3, 4, 2)
    assert simulate(cell, 20, 1) == simulate(cell, 20, 1)
    assert simulate(cell, 20, 1) != simulate(cell, 20, 2)


def test_looks_spend_fewer_seeds_where_effects_are_plain():
    told = simulate(GridRow(10, 40, 1), 20, 0)["campaign"]
    assert told["decided"] > 0.95
    assert told["seeds"] < 9
    assert told["error"] <= 0.05


def test_a_broken_promise_is_told():
    row = {"tables": 1000, "shares": {"one": {"coverage": 0.95, "error": 0.05, "sequential_error": 0.03}}}
    assert broken(row, True) == []
    row["shares"]["other"] = {"coverage": 0.999, "error": 0.09, "sequential_error": 0.01}
    assert broken(row, False) == ["error 9.00 % (other)"]
    assert broken(row, True) == ["error 9.00 % (other)", "coverage 99.90 % (other)"]
    row["shares"]["other"] = {"coverage": 0.92, "error": 0.0, "sequential_error": 0.09}
    assert broken(row, True) == ["coverage 92.00 % (other)", "sequential_error 9.00 % (other)"]


def test_the_command(memmlp, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(verdict_simulation, "grid", lambda: [GridRow(3, 10, 2), GridRow(5, 536, 10)])
    file = tmp_path / "rates.json"
    ran = memmlp("bench", "calibration", "--quick", "--tables", "30", "--json", str(file), "--markdown")
    assert ran.code == 0, ran.err
    (row,) = read_json(file)["cells"]
    assert (row["seeds"], row["clips"], row["size"], row["groups"]) == (3, 10, 2, 5)
    assert f"| 3 x 10 / 2 | {100 * min(s['coverage'] for s in row['shares'].values()):.1f}-" in ran.out
    monkeypatch.setattr(verdict_simulation, "MOST", 0.8)
    ran = memmlp("bench", "calibration", "--quick", "--tables", "30")
    assert ran.code == 1
    assert "broken at 3 seeds x 10 clips, 2 a group: coverage" in ran.out
    assert max(map(len, ran.out.splitlines())) < 120
    assert "no folder" in memmlp("bench", "calibration", "--json", str(tmp_path / "none" / "f")).err
