"""Statistics of paired differences: intervals, p-values, power, verdicts, and what they promise."""

import numpy as np
import pytest
from drawn import SHARES, TABLE, differences, groups, starred
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from memmlp.report.tables.statistics import (
    EffectEstimates,
    Verdict,
    compute_bootstrap_p,
    compute_detectable,
    compute_equivalence_p,
    correct_by_holm,
    correct_sequentially,
    count_needed_seeds,
    decide_verdict,
    divide_level,
    estimate_error,
    estimate_paired_effects,
    make_schedule,
    reduce_freedom,
)


def test_two_by_two_by_hand():
    # Seeds' means 2, 4 and clips' means 2, 4: A = B = 2 / 2; nothing is left, so E = 0.
    known = estimate_error(np.array([[[1.0, 3.0], [3.0, 5.0]]]))
    np.testing.assert_allclose(known.variances[:, 0], [1, 1, 0], atol=1e-12)
    # 0.9 degrees of freedom for clips, which may be skewed
    half = np.hypot(stats.t.ppf(0.975, 1), stats.t.ppf(0.975, 0.9))
    effects = estimate_paired_effects(np.array([[[1.0, 3.0], [3.0, 5.0]]]))
    assert effects.mean[0] == 3
    assert effects.high[0] == pytest.approx(3 + half)
    assert effects.low[0] == pytest.approx(3 - half)
    # No seed and no clip differs from another: all is noise, of squares 4 with one degree of freedom.
    noise = estimate_error(np.array([[[1.0, -1.0], [-1.0, 1.0]]]))
    np.testing.assert_allclose(noise.variances[:, 0], [0, 0, 1])


def test_clips_or_seeds_that_do_not_differ_leave_students_test_of_the_others():
    sample = np.random.default_rng(2).normal(1, 1, 12)
    effects = estimate_paired_effects(np.repeat(sample[None, :6, None], 9, 2))
    expected = stats.ttest_1samp(sample[:6], 0)
    assert effects.p[0] == pytest.approx(expected.pvalue, rel=1e-9)
    assert effects.low[0] == pytest.approx(expected.confidence_interval().low)
    effects = estimate_paired_effects(np.repeat(sample[None, None], 3, 1))
    t = sample.mean() / stats.sem(sample)
    assert effects.p[0] == pytest.approx(2 * stats.t.sf(t, 0.9 * 11**0.6), rel=1e-6)


def test_equal_groups_are_the_analysis_of_their_means():
    d = np.random.default_rng(3).normal(size=(5, 3, 12))
    labels = np.array(list("aabbccddeeff"))
    order = np.random.default_rng(4).permutation(12)
    grouped = estimate_paired_effects(d[:, :, order], labels[order])
    for ours, theirs in zip(
        grouped[:4], estimate_paired_effects(d.reshape(5, 3, 6, 2).mean(3))[:4], strict=True
    ):
        np.testing.assert_allclose(ours, theirs)


def test_unequal_groups_weigh_as_their_clips():
    # weights 1/4 and 3/4; seeds' means by group 0, 4 and 2, 4, over both 3 and 3.5; groups' means 1 and 4
    d = np.array([[[0.0, 4.0, 5.0, 3.0], [2.0, 4.0, 3.0, 5.0]]])
    assert estimate_paired_effects(d, [7, 1, 1, 1]).mean[0] == 3.25
    # 0.125 / 2; 4.5 x 10/16; what is left is -1, 0 and 1, 0: (0.5 + 0.5) x 10/16 / 2
    np.testing.assert_allclose(estimate_error(d, [7, 1, 1, 1]).variances[:, 0], [0.0625, 2.8125, 0.3125])


@pytest.mark.parametrize(
    ("shape", "labels", "conditional"),
    [((1, 5), None, "seeds"), ((5, 1), None, "clips"), ((5, 4), [2, 2, 2, 2], "clips")],
)
def test_one_seed_or_one_group_has_an_interval_of_the_other_alone(shape, labels, conditional: str):
    d = np.random.default_rng(1).normal(3, 0.1, (2, *shape))
    effects = estimate_paired_effects(d, labels)
    assert np.isnan(effects.p).all()
    assert (effects.low < effects.mean).all()
    assert (effects.mean < effects.high).all()
    assert np.isnan(compute_equivalence_p(d, 100, labels)).all()
    assert np.isnan(compute_detectable(d, 1, labels)).all()
    if conditional == "clips":
        sample = d.mean(2)[0]
        assert effects.high[0] == pytest.approx(stats.ttest_1samp(sample, 0).confidence_interval().high)


def test_differences_that_are_all_the_same():
    effects = estimate_paired_effects(np.stack([np.zeros((3, 4)), np.full((3, 4), 2.0)]))
    np.testing.assert_array_equal(effects.low, [0, 2])
    np.testing.assert_array_equal(effects.high, [0, 2])
    np.testing.assert_array_equal(effects.p, [1, 0])
    np.testing.assert_array_equal(compute_equivalence_p(np.full((1, 3, 4), 2.0), 3), [0])


@pytest.mark.parametrize("shares", SHARES.values())
def test_zero_is_outside_exactly_where_p_is_small(shares: tuple[float, ...]):
    d = differences(4, 6, 1, shares, tables=40) + np.linspace(-8, 8, 40 * TABLE)[:, None, None]
    effects = estimate_paired_effects(d)
    inside = (effects.low < 0) & (effects.high > 0)
    np.testing.assert_array_equal(inside, effects.p > 0.05)
    assert 0.2 < inside.mean() < 0.8
    np.testing.assert_allclose(
        estimate_error(d).compute_half_width(effects.p), np.abs(effects.mean), rtol=1e-6
    )


def test_equivalence_is_the_interval_within_the_margin():
    d = differences(6, 40, 1, SHARES["equal"], tables=20)
    effects, p = estimate_paired_effects(d), compute_equivalence_p(d, 4.0)
    within = (effects.low > -4) & (effects.high < 4)
    np.testing.assert_array_equal(within, p < 0.05)
    assert 0.1 < within.mean() < 0.9
    assert compute_equivalence_p(d + 10, 4.0).min() == 1
    np.testing.assert_array_equal(compute_equivalence_p(d, np.full(len(d), 4.0)), p)


def test_a_bootstrap_p_is_the_rate_of_smaller_p_among_tables_without_an_effect():
    labels, rng = np.repeat(np.arange(6), [5, 1, 1, 2, 1, 2]), np.random.default_rng(3)
    d = 0.1 * rng.normal(size=(1, 3, 1)) + rng.normal(size=(1, 1, 6))[..., labels]  # noise would count twice
    d += 1.5 - d.mean()
    p, weights = estimate_paired_effects(d, labels).p[0], np.bincount(labels) / len(labels)
    a, b, _ = np.sqrt(estimate_error(d, labels).variances[:, 0])
    rates = []
    for seeds in (a, a * np.sqrt(2 / stats.chi2.ppf(p, 2))):  # the estimate, and its upper limit
        for effects in (rng.normal(size=(20000, 6)), rng.exponential(size=(20000, 6)) - 1):
            by_group = b * effects / np.sqrt(weights @ weights)
            tables = seeds * np.sqrt(3) * rng.normal(size=(20000, 3, 1)) + by_group[:, None, labels]
            rates.append(np.mean(estimate_paired_effects(tables, labels).p <= p))
    assert compute_bootstrap_p(d, labels)[0] == pytest.approx(max(rates), rel=0.2)
    assert 1.3 * sorted(rates)[-2] < max(rates) < 0.4 * p
    assert np.isnan(compute_bootstrap_p(np.tile(d, 3), np.arange(36))).all()  # too many groups
    assert np.isnan(compute_bootstrap_p(d[:, :1], labels)).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", SHARES)
def test_promises(name: str):
    for shape in [(3, 4, 1), (5, 10, 2), (5, 40, 10)]:
        d = differences(*shape, SHARES[name], tables=300)
        effects = estimate_paired_effects(d, groups(*shape[1:]))
        covered = np.mean((effects.low <= 0) & (effects.high >= 0))
        assert covered >= 0.93
        assert covered <= 0.995 or shape[1] / shape[2] < 5
        assert starred(effects.p) <= 0.08  # of a family-wise error of 5 %, the standard error is 1.3 %


def test_unequal_groups_keep_the_promises():
    labels = np.repeat(np.arange(5), [9, 4, 1, 1, 1])
    rng = np.random.default_rng(1)
    for by_clip, by_group in ((1, 0), (0, 1), (1, 1)):
        groups = by_group * rng.normal(size=(9600, 1, 5))[:, :, labels]
        noise = 1e-3 * rng.normal(size=(9600, 3, 16))
        effects = estimate_paired_effects(by_clip * rng.normal(size=(9600, 1, 16)) + groups + noise, labels)
        assert np.mean((effects.low <= 0) & (effects.high >= 0)) >= 0.95
        assert starred(effects.p) <= 0.05


sizes = st.tuples(st.integers(2, 4), st.integers(2, 6), st.integers(0, 1000))


def assert_same(one: EffectEstimates, other: EffectEstimates) -> None:
    for a, b in zip(one[:4], other[:4], strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-9)


@settings(max_examples=10)
@given(sizes)
def test_order_and_names_do_not_matter(size: tuple[int, int, int]):
    seeds, clips, number = size
    rng = np.random.default_rng(number)
    d, labels = rng.normal(0.5, 1, (3, seeds, clips)), rng.integers(0, 3, clips)
    effects = estimate_paired_effects(d, labels)
    order = rng.permutation(clips)
    assert_same(effects, estimate_paired_effects(d[:, rng.permutation(seeds)][:, :, order], labels[order]))
    assert_same(effects, estimate_paired_effects(d, np.array(["z", "a", "m"])[labels]))
    assert_same(estimate_paired_effects(d), estimate_paired_effects(d, np.arange(clips)))
    alone = [estimate_paired_effects(one[None], labels) for one in d]
    assert_same(effects, EffectEstimates(*(np.concatenate([e[i] for e in alone]) for i in range(4))))


@settings(max_examples=10)
@given(sizes, st.floats(0.01, 100))
def test_units_and_signs_do_not_matter(size: tuple[int, int, int], scale: float):
    seeds, clips, number = size
    d = np.random.default_rng(number).normal(0.5, 1, (3, seeds, clips))
    e, scaled, turned = map(estimate_paired_effects, (d, scale * d, -d))
    assert_same(scaled, EffectEstimates(scale * e.mean, scale * e.low, scale * e.high, e.p))
    assert_same(turned, EffectEstimates(-e.mean, -e.high, -e.low, e.p))
    np.testing.assert_allclose(compute_detectable(scale * d, 5), scale * compute_detectable(d, 5))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_an_error_that_is_no_number_is_evidence_of_nothing(value: float):
    """Of a network that diverged on one clip; the other comparison keeps its own."""
    differences = np.random.default_rng(0).normal(1, 0.1, size=(2, 3, 8))
    alone = estimate_paired_effects(differences[1:]).p
    differences[0, 1, 2] = value
    with np.errstate(invalid="ignore"):
        p, equal = estimate_paired_effects(differences).p, compute_equivalence_p(differences, 5.0)
    assert np.isnan([p[0], equal[0]]).all()
    assert p[1] == alone[0]
    assert equal[1] < 0.05


def test_noise_is_counted_once():
    # A = B = E, as of noise alone: no wider than the wider of the two sides alone
    known = estimate_error(np.random.default_rng(0).normal(size=(1, 8, 8)))
    known.variances[:] = 1.0
    assert known.compute_half_width(0.001)[0] == pytest.approx(stats.t.isf(0.0005, 0.9 * 7**0.6), rel=0.01)


@pytest.mark.parametrize("count", [2, 10, 40])
def test_means_of_few_skewed_values_have_the_tails_they_are_given(count: int):
    x = np.random.default_rng(count).exponential(size=(100_000, count)) - 1
    t = np.abs(x.mean(1)) / (x.std(1, ddof=1) / np.sqrt(count))
    for level in (0.05, 0.05 / TABLE):
        missed = np.mean(t > stats.t.isf(level / 2, reduce_freedom(count - 1)))
        assert 0.45 * level < missed < 1.45 * level
        assert np.mean(t > stats.t.isf(level / 2, count - 1)) > 1.3 * level


@pytest.mark.parametrize("comparisons", [1, 24])
@pytest.mark.parametrize("shape", [(5, 12), (12, 40)])
def test_detectable_is_found_with_its_power(shape: tuple[int, int], comparisons: int):
    # Differences whose measured shares are what the repetitions are drawn from; these have normal effects.
    d = differences(*shape, 1, SHARES["equal"], tables=1)[:1]
    a, b, e = estimate_error(d).variances[:, 0]
    rng = np.random.default_rng(5)
    again = (
        np.sqrt(shape[0] * max(a - e, 0)) * rng.normal(size=(4000, shape[0], 1))
        + np.sqrt(shape[1] * max(b - e, 0)) * rng.normal(size=(4000, 1, shape[1]))
        + np.sqrt(shape[0] * shape[1] * e) * rng.normal(size=(4000, *shape))
    )
    for power in (0.5, 0.8):
        effect = compute_detectable(d, comparisons, power=power)[0]
        found = np.mean(estimate_paired_effects(again + effect).p <= 0.05 / comparisons)
        assert found == pytest.approx(power, abs=0.03)


def test_holm_by_known_examples_leaves_nan_out():
    """Of Wikipedia, "Holm-Bonferroni method", and of R's p.adjust."""
    known = {
        (0.01, 0.04, 0.03, 0.005): [0.03, 0.06, 0.06, 0.02],
        (0.7, np.nan, 0.02, 0.6): [1, np.nan, 0.06, 1],
    }
    known |= {(0.01, 0.02, 0.03, 0.04, 0.05): [0.05, 0.08, 0.09, 0.09, 0.09], (): []}
    for p, corrected in known.items():
        np.testing.assert_allclose(correct_by_holm(np.array(p)), corrected)


@pytest.mark.parametrize(("difference", "equivalence", "mean", "paper", "expected"), [
    (0.01, 1.0, -0.3, -2.0, Verdict.HOLDS), (0.01, 1.0, 0.3, -2.0, Verdict.OPPOSITE),
    (0.01, 1.0, 0.3, None, Verdict.HIGHER), (0.01, 1.0, -0.3, 0.0, Verdict.LOWER),
    (0.05, 0.06, 0.3, 2.0, Verdict.HOLDS), (0.01, 0.05, 0.3, 2.0, Verdict.EQUIVALENT),
    (0.06, 0.06, 0.3, 2.0, Verdict.INCONCLUSIVE), (np.nan, np.nan, 0.3, 2.0, Verdict.INCONCLUSIVE),
])  # fmt: skip
def test_verdicts(difference: float, equivalence: float, mean: float, paper: float | None, expected: Verdict):
    assert decide_verdict(difference, equivalence, mean, paper) is expected
    assert decide_verdict(0.03, 1.0, 1.0, 1.0, level=0.02) is Verdict.INCONCLUSIVE
    assert decide_verdict(0.03, 1.0, 1.0, 1.0, level=0.03) is Verdict.HOLDS


def test_looks_and_what_they_spend():
    assert make_schedule(13) == (3, 5, 8, 13)
    assert make_schedule(10) == (3, 5, 8, 10)
    assert make_schedule(2) == (2,)
    assert divide_level(1) == (0.05,)
    assert divide_level(2) == pytest.approx((0.05 / 3, 0.1 / 3))
    assert sum(divide_level(5)) == pytest.approx(0.05)


def test_claims_leave_the_correction_and_other_decisions_stay_in_it():
    p = np.array([0.5, 0.01, 0.001, 0.02, np.nan])
    claimed = np.array([True, False, False, False, False])
    closed = np.array([False, False, True, False, False])
    # of four, one is claimed and one can't be: 0.01 is corrected for the three that are left
    np.testing.assert_allclose(correct_sequentially(p, claimed, closed), [0, 0.03, 1, 0.04, np.nan])


def test_looks_keep_the_error_where_one_level_for_all_would_not():
    d = differences(13, 8, 1, SHARES["seeds"], tables=600)
    rounds = make_schedule(13)
    kept, wasted = np.zeros((2, 600), bool)
    for seeds, level in zip(rounds, divide_level(len(rounds)), strict=True):
        p = estimate_paired_effects(d[:, :seeds]).p.reshape(600, TABLE)
        least = np.array([correct_by_holm(row).min() for row in p])
        kept |= least <= level
        wasted |= least <= 0.05
    assert kept.mean() <= 0.06 < 0.09 < wasted.mean()


def test_needed_seeds_are_the_first_that_suffice():
    d = differences(4, 20, 1, (1, 0, 0.02, 0, 1), tables=1)[0]
    few, many = count_needed_seeds(d, 12.0, TABLE), count_needed_seeds(d, -6.0, TABLE)
    assert few is not None
    assert many is not None
    assert 2 <= few < many
    assert count_needed_seeds(d, 6.0, TABLE, max_seeds=many - 1) is None
    measured = compute_detectable(d[None], TABLE)[0]
    assert count_needed_seeds(d, 1.0001 * measured, TABLE) == 4
    assert count_needed_seeds(d, 0.9999 * measured, TABLE) == 5
    few_clips = differences(4, 4, 1, (1, 0, 10, 0, 0.1), tables=1)[0]
    assert count_needed_seeds(few_clips, 3.0, TABLE) is None
