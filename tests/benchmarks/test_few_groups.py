"""Simulated differences have variance 1; p keeps its level, and resampling tests do not."""

import numpy as np
import pytest
from benchmarks.few_groups import (
    SHAPES,
    SHARES,
    compute_resampled_p,
    draw_differences,
    find_broken,
    simulate,
    simulate_resampling,
)
from scipy import stats


def test_means_have_a_variance_of_one():
    for shape in set(SHAPES) - {"heavy tails"}:  # whose sample variances vary without limit
        for shares in SHARES:
            drawn = draw_differences(np.random.default_rng(2), 8000, 3, 9, shape, shares)
            assert drawn.mean((1, 2)).var() == pytest.approx(1, abs=0.1), (shape, shares)


def test_flips_are_the_exact_test_and_the_bootstrap_is_near_students():
    sample = np.random.default_rng(4).normal(0.5, 1, 9)
    p = compute_resampled_p(np.random.default_rng(0), sample[None])
    known = stats.permutation_test((sample,), np.mean, permutation_type="samples", n_resamples=np.inf)
    assert p["flips"][0] == pytest.approx(known.pvalue)
    for name in ("flips of skew-corrected t", "bootstrap-t"):
        assert p[name][0] == pytest.approx(stats.ttest_1samp(sample, 0).pvalue, abs=0.05)


def test_p_keeps_its_level_and_resampling_does_not():
    assert not find_broken([error for error, _ in simulate(9, 5, 200, 0).values()], 200)
    errors = simulate_resampling("skewed differences", 14, 1000, 0)
    assert find_broken(errors.pop("flips"), 1000)
    assert not find_broken(errors.pop("p")[:1], 1000)
