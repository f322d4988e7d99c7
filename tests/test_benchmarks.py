"""The statistics' p keeps its level in simulations, and resampling tests do not."""

from benchmarks import few_groups


def test_p_keeps_its_level_and_resampling_does_not():
    assert not few_groups.find_broken([error for error, _ in few_groups.simulate(9, 5, 200, 0).values()], 200)
    errors = few_groups.simulate_resampling("skewed differences", 14, 1000, 0)
    assert few_groups.find_broken(errors.pop("flips"), 1000)
    assert not few_groups.find_broken(errors.pop("p")[:1], 1000)
