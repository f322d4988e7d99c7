"""Paired differences with their intervals and p-values, and Holm's correction."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from memmlp.statistics import holm, paired_effects, percentiles, standard_error

SHARES = {"equal": (1, 1, 1), "noise": (0, 0, 1), "seeds": (1, 0, 0.1), "clips": (0, 1, 0.1)}


def differences(seeds: int, clips: int, shares: tuple[float, float, float], sets: int, seed: int = 0):
    """Sets of differences (sets, S, C) around 0: effects of seeds and clips and noise in these shares."""
    rng = np.random.default_rng(seed)
    a, b, e = np.sqrt([shares[0] * seeds, shares[1] * clips, shares[2] * seeds * clips])
    noise = e * rng.normal(size=(sets, seeds, clips))
    return a * rng.normal(size=(sets, seeds, 1)) + b * rng.normal(size=(sets, 1, clips)) + noise


def test_standard_error_by_hand():
    # means 2, 4 over clips and over seeds: variances 2, so 2/2 + 2/2 with 2^2 / (1 + 1) degrees of freedom
    error, freedom = standard_error(np.array([[[1.0, 3.0], [3.0, 5.0]]]))
    assert error[0] ** 2 == pytest.approx(2)
    assert freedom[0] == pytest.approx(2)
    effects = paired_effects(np.array([[[1.0, 3.0], [3.0, 5.0]]]))
    assert effects.mean[0] == 3
    assert effects.p[0] == pytest.approx(2 * stats.t.sf(3 / np.sqrt(2), 2))


@pytest.mark.parametrize("axis", [1, 2])
def test_one_seed_or_one_clip_is_students_test(axis: int):
    sample = np.random.default_rng(2).normal(1, 1, 12)
    effects = paired_effects(np.expand_dims(sample, (0, axis)))
    expected = stats.ttest_1samp(sample, 0)
    interval = expected.confidence_interval()
    width = interval.high - interval.low
    assert effects.p[0] == pytest.approx(expected.pvalue)
    assert effects.low[0] == pytest.approx(interval.low, abs=0.1 * width)
    assert effects.high[0] == pytest.approx(interval.high, abs=0.1 * width)


@pytest.mark.parametrize("name", SHARES)
@pytest.mark.parametrize("shape", [(3, 4), (3, 10), (5, 4)])
def test_coverage(shape: tuple[int, int], name: str):
    effects = paired_effects(differences(*shape, SHARES[name], sets=2000))
    covered = np.mean((effects.low <= 0) & (effects.high >= 0))
    assert 0.925 <= covered <= 0.997
    assert np.mean(effects.p < 0.05) == pytest.approx(1 - covered, abs=0.02)


def test_percentiles_alone_cover_too_little():
    sets = differences(3, 4, SHARES["seeds"], sets=2000)
    mean = sets.mean((1, 2))
    _, low, high = percentiles(sets - mean[:, None, None], 0.025)
    assert np.mean((mean + low <= 0) & (mean + high >= 0)) < 0.87


def test_interval_leans_where_the_bootstrap_does():
    clips = np.r_[np.zeros(18), 5.0, 6.0]
    effects = paired_effects(clips[None, None])
    assert effects.high[0] - effects.mean[0] > 1.1 * (effects.mean[0] - effects.low[0])


def test_many_comparisons_are_each_by_itself(monkeypatch: pytest.MonkeyPatch):
    sets = differences(3, 4, SHARES["equal"], sets=7)
    together = paired_effects(sets)
    monkeypatch.setattr("memmlp.statistics.CHUNK", 1)
    for i, one in enumerate(sets):
        np.testing.assert_allclose(np.ravel(paired_effects(one[None])), [field[i] for field in together])


def test_no_interval_from_one_value():
    effects = paired_effects(np.full((1, 1, 1), 0.3))
    assert effects.mean[0] == 0.3
    assert np.isnan([effects.low[0], effects.high[0], effects.p[0]]).all()


def test_differences_that_are_all_the_same():
    effects = paired_effects(np.stack([np.zeros((3, 4)), np.full((3, 4), 2.0)]))
    np.testing.assert_array_equal(effects.low, [0, 2])
    np.testing.assert_array_equal(effects.high, [0, 2])
    np.testing.assert_array_equal(effects.p, [1, 0])


def test_holm_known_examples():
    # Wikipedia, "Holm-Bonferroni method"; R: p.adjust(c(0.01, 0.02, 0.03, 0.04, 0.05), "holm")
    np.testing.assert_allclose(holm(np.array([0.01, 0.04, 0.03, 0.005])), [0.03, 0.06, 0.06, 0.02])
    np.testing.assert_allclose(holm(np.array([0.01, 0.02, 0.03, 0.04, 0.05])), [0.05, 0.08, 0.09, 0.09, 0.09])


def test_holm_stays_below_one_and_leaves_nan_out():
    np.testing.assert_allclose(holm(np.array([0.7, np.nan, 0.02, 0.6])), [1, np.nan, 0.06, 1])
    assert holm(np.array([])).shape == (0,)
