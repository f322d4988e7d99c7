"""The statistics' p keeps its level in simulations, and resampling tests do not."""

import numpy as np

from benchmarks import few_groups


def test_p_keeps_its_level_and_resampling_does_not():
    assert not few_groups.find_broken([error for error, _ in few_groups.simulate(9, 5, 200, 0).values()], 200)
    rng = np.random.default_rng(0)
    errors = few_groups.count_bootstrap_claims(rng, 3, 14, 200, "skewed differences", (1, 1, 1))
    assert not few_groups.find_broken(list(errors)[:2], 200)
    errors = few_groups.simulate_resampling("skewed differences", 14, 500, 0)
    assert few_groups.find_broken(errors.pop("flips"), 500)
    assert not few_groups.find_broken(errors.pop("p")[:1], 500)
