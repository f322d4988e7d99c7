"""What may be claimed of many comparisons, at once and in looks."""

from __future__ import annotations

import numpy as np
import pytest
from drawn import SHARES, TABLE, differences

from memmlp.report.tables.statistics import (
    Verdict,
    analysis_schedule,
    holm,
    paired_effects,
    sequential,
    spending,
    verdict,
)


def test_holm_known_examples():
    # Wikipedia, "Holm-Bonferroni method"; R: p.adjust(c(0.01, 0.02, 0.03, 0.04, 0.05), "holm")
    np.testing.assert_allclose(holm(np.array([0.01, 0.04, 0.03, 0.005])), [0.03, 0.06, 0.06, 0.02])
    np.testing.assert_allclose(holm(np.array([0.01, 0.02, 0.03, 0.04, 0.05])), [0.05, 0.08, 0.09, 0.09, 0.09])


def test_holm_stays_below_one_and_leaves_nan_out():
    np.testing.assert_allclose(holm(np.array([0.7, np.nan, 0.02, 0.6])), [1, np.nan, 0.06, 1])
    assert holm(np.array([])).shape == (0,)


@pytest.mark.parametrize(
    ("difference", "equivalence", "mean", "paper", "expected"),
    [
        (0.01, 1.0, -0.3, -2.0, Verdict.HOLDS),
        (0.01, 1.0, 0.3, -2.0, Verdict.OPPOSITE),
        (0.01, 1.0, 0.3, None, Verdict.HIGHER),
        (0.01, 1.0, -0.3, 0.0, Verdict.LOWER),
        (0.05, 0.06, 0.3, 2.0, Verdict.HOLDS),
        (0.01, 0.05, 0.3, 2.0, Verdict.EQUIVALENT),
        (0.06, 0.06, 0.3, 2.0, Verdict.INCONCLUSIVE),
        (np.nan, np.nan, 0.3, 2.0, Verdict.INCONCLUSIVE),
    ],
)
def test_verdicts(difference: float, equivalence: float, mean: float, paper: float | None, expected: Verdict):
    assert verdict(difference, equivalence, mean, paper) is expected


def test_a_look_has_its_own_level():
    assert verdict(0.03, 1.0, 1.0, 1.0, level=0.02) is Verdict.INCONCLUSIVE
    assert verdict(0.03, 1.0, 1.0, 1.0, level=0.03) is Verdict.HOLDS


def test_looks_and_what_they_spend():
    assert analysis_schedule(13) == (3, 5, 8, 13)
    assert analysis_schedule(10) == (3, 5, 8, 10)
    assert analysis_schedule(2) == (2,)
    assert spending(1) == (0.05,)
    assert spending(2) == pytest.approx((0.05 / 3, 0.1 / 3))
    assert sum(spending(5)) == pytest.approx(0.05)


def test_claims_leave_the_correction_and_other_decisions_stay_in_it():
    p = np.array([0.5, 0.01, 0.001, 0.02, np.nan])
    claimed = np.array([True, False, False, False, False])
    closed = np.array([False, False, True, False, False])
    # of four, one is claimed and one can't be: 0.01 is corrected for the three that are left
    np.testing.assert_allclose(sequential(p, claimed, closed), [0, 0.03, 1, 0.04, np.nan])


def test_looks_keep_the_error_where_one_level_for_all_would_not():
    d = differences(13, 8, 1, SHARES["seeds"], tables=600)
    rounds = analysis_schedule(13)
    kept, wasted = np.zeros((2, 600), bool)
    for seeds, level in zip(rounds, spending(len(rounds)), strict=True):
        p = paired_effects(d[:, :seeds]).p.reshape(600, TABLE)
        least = np.array([holm(row).min() for row in p])
        kept |= least <= level
        wasted |= least <= 0.05
    assert kept.mean() <= 0.06 < 0.09 < wasted.mean()
