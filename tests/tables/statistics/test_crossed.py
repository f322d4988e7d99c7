"""The error of a mean over seeds and groups of clips."""

from __future__ import annotations

import numpy as np
import pytest
from drawn import TABLE
from scipy import stats

from memmlp.tables.statistics.crossed import error, skewed


def test_noise_by_hand():
    # No seed and no clip differs from another: all is noise, of squares 4 with one degree of freedom.
    known = error(np.array([[[1.0, -1.0], [-1.0, 1.0]]]))
    np.testing.assert_allclose(known.variances[:, 0], [0, 0, 1])


def test_noise_is_counted_once():
    # A = B = E, as of noise alone: no wider than the wider of the two sides alone
    known = error(np.random.default_rng(0).normal(size=(1, 8, 8)))
    known.variances[:] = 1.0
    assert known.half(0.001)[0] == pytest.approx(stats.t.isf(0.0005, 0.9 * 7**0.6), rel=0.01)


@pytest.mark.parametrize("count", [2, 3, 5, 10, 40])
def test_means_of_few_skewed_values_have_the_tails_they_are_given(count: int):
    x = np.random.default_rng(count).exponential(size=(200_000, count)) - 1
    t = np.abs(x.mean(1)) / (x.std(1, ddof=1) / np.sqrt(count))
    for level in (0.05, 0.05 / TABLE):
        missed = np.mean(t > stats.t.isf(level / 2, skewed(count - 1)))
        assert 0.45 * level < missed < 1.45 * level
        assert np.mean(t > stats.t.isf(level / 2, count - 1)) > 1.3 * level
