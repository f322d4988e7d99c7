"""How often verdicts are wrong is counted, and promises that are broken are told."""

from __future__ import annotations

from memmlp.tables.statistics.simulation import SimulationSetting
from memmlp.tables.statistics.verdict_error_rates import broken, grid, simulate


def test_the_grid_is_all_that_have_two_groups():
    assert len(grid()) == 40
    assert SimulationSetting(3, 10, 10) not in grid()
    assert SimulationSetting(10, 536, 10) in grid()
    assert [
        cell.capped
        for cell in (SimulationSetting(2, 40, 1), SimulationSetting(3, 4, 1), SimulationSetting(3, 10, 2))
    ] == [
        False,
        False,
        True,
    ]


def test_a_cell_is_the_same_again_and_another_with_another_seed():
    cell = SimulationSetting(3, 4, 2)
    assert simulate(cell, 20, 1) == simulate(cell, 20, 1)
    assert simulate(cell, 20, 1) != simulate(cell, 20, 2)


def test_looks_spend_fewer_seeds_where_effects_are_plain():
    told = simulate(SimulationSetting(10, 40, 1), 20, 0)["campaign"]
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
