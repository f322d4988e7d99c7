"""Descriptions without a test, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from memmlp.report.tables.error_distributions import (
    interquartile_mean,
    performance_profile,
    probability_of_improvement,
)


def test_probability_of_improvement_by_hand():
    ours, theirs = np.array([[1.0, 5.0], [2.0, 5.0]]), np.array([[2.0, 4.0]])
    # clip 1: smaller, equal; clip 2: never
    assert probability_of_improvement(ours, theirs) == pytest.approx((0.75 + 0) / 2)
    assert probability_of_improvement(theirs, ours) == pytest.approx(1 - 0.375)


def test_interquartile_mean_by_hand():
    assert interquartile_mean(np.array([[0.0, 1.0, 2.0, 3.0], [4.0, 5.0, 6.0, 1000.0]])) == 3.5


def test_performance_profile_by_hand():
    errors = np.array([[1.0, 2.0], [3.0, 4.0]])
    np.testing.assert_array_equal(performance_profile(errors, np.array([0.5, 2.0, 3.5])), [0, 0.5, 0.75])
