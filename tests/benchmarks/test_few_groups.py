"""The simulation of few groups decides as the p-values do, from differences of variance 1."""

import numpy as np
import pytest
from benchmarks.few_groups import (
    SHAPES,
    SHARES,
    draw_differences,
    find_broken,
    is_significant_by_flips,
    simulate,
)

from memmlp.report.tables.statistics import compute_flip_p, estimate_error


@pytest.mark.parametrize(("groups", "seeds"), [(8, 2), (9, 20), (14, 5), (24, 3)])
def test_a_level_decides_as_the_p_value(groups: int, seeds: int):
    drawn = draw_differences(np.random.default_rng(1), 100, seeds, groups, "heavy tails", (1, 1, 1))
    drawn[::2] += 2
    p, known = compute_flip_p(drawn), estimate_error(drawn)
    for level in (0.05, 0.05 / 12):
        np.testing.assert_array_equal(is_significant_by_flips(drawn, known, level), p <= level)
    assert (p <= 0.05).any()


def test_means_have_a_variance_of_one():
    for shape in set(SHAPES) - {"heavy tails"}:  # whose sample variances vary without limit
        for shares in SHARES:
            drawn = draw_differences(np.random.default_rng(2), 8000, 3, 9, shape, shares)
            assert drawn.mean((1, 2)).var() == pytest.approx(1, abs=0.1), (shape, shares)


def test_false_claims_of_skewed_differences_are_counted_apart():
    errors = simulate(9, 5, 200, 0)
    assert not find_broken(errors, 200)
    assert errors["skewed differences"][1] > 0.1
    assert find_broken({**errors, "flips": [0.2]}, 200)
