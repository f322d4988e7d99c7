"""Simulated differences have the documented variances; p keeps its level, and resampling tests do not."""

from benchmarks import few_groups, verdicts
from benchmarks.verdicts import SimulationSetting


def test_p_keeps_its_level_and_resampling_does_not():
    assert not few_groups.find_broken([error for error, _ in few_groups.simulate(9, 5, 200, 0).values()], 200)
    errors = few_groups.simulate_resampling("skewed differences", 14, 1000, 0)
    assert few_groups.find_broken(errors.pop("flips"), 1000)
    assert not few_groups.find_broken(errors.pop("p")[:1], 1000)


def test_a_cell_is_reproducible_and_broken_promises_are_listed():
    assert len(verdicts.grid()) == 40
    small, large = SimulationSetting(3, 4, 2), SimulationSetting(10, 40, 1)
    assert (
        verdicts.simulate(small, 20, 1) == verdicts.simulate(small, 20, 1) != verdicts.simulate(small, 20, 2)
    )
    campaign = verdicts.simulate(large, 20, 0)["campaign"]
    assert campaign["decided"] > 0.95
    assert campaign["seeds"] < 9
    assert campaign["error"] <= 0.05
    row = {"tables": 1000, "shares": {"one": {"coverage": 0.95, "error": 0.05, "sequential_error": 0.03}}}
    assert verdicts.broken(row, True) == []
    row["shares"]["other"] = {"coverage": 0.999, "error": 0.09, "sequential_error": 0.01}
    assert verdicts.broken(row, False) == ["error 9.00 % (other)"]
    assert verdicts.broken(row, True) == ["error 9.00 % (other)", "coverage 99.90 % (other)"]
    row["shares"]["other"] = {"coverage": 0.92, "error": 0.0, "sequential_error": 0.09}
    assert verdicts.broken(row, True) == ["coverage 92.00 % (other)", "sequential_error 9.00 % (other)"]
