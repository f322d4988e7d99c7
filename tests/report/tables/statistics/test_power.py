"""Which effects could have been seen, and how many seeds would do."""

from __future__ import annotations

import numpy as np
import pytest
from drawn import SHARES, TABLE, differences

from memmlp.report.tables.statistics import (
    detectable,
    paired_effects,
    seeds_needed,
)
from memmlp.report.tables.statistics.paired_differences import error


@pytest.mark.parametrize("comparisons", [1, 24])
@pytest.mark.parametrize("shape", [(5, 12), (12, 40)])
def test_detectable_is_found_with_its_power(shape: tuple[int, int], comparisons: int):
    # Differences whose measured shares are what the repetitions are drawn from; these have normal effects.
    d = differences(*shape, 1, SHARES["equal"], tables=1)[:1]
    a, b, e = error(d).variances[:, 0]
    rng = np.random.default_rng(5)
    again = (
        np.sqrt(shape[0] * max(a - e, 0)) * rng.normal(size=(4000, shape[0], 1))
        + np.sqrt(shape[1] * max(b - e, 0)) * rng.normal(size=(4000, 1, shape[1]))
        + np.sqrt(shape[0] * shape[1] * e) * rng.normal(size=(4000, *shape))
    )
    for power in (0.5, 0.8):
        effect = detectable(d, comparisons, power=power)[0]
        found = np.mean(paired_effects(again + effect).p <= 0.05 / comparisons)
        assert found == pytest.approx(power, abs=0.03)


def test_seeds_needed_are_the_first_that_suffice():
    d = differences(4, 20, 1, (1, 0, 0.02, 0, 1), tables=1)[0]
    few, many = seeds_needed(d, 12.0, TABLE), seeds_needed(d, 6.0, TABLE)
    assert few is not None
    assert many is not None
    assert 2 <= few < many
    assert seeds_needed(d[None], -6.0, TABLE) == many
    assert seeds_needed(d, 6.0, TABLE, most=many) == many
    assert seeds_needed(d, 6.0, TABLE, most=many - 1) is None
    measured = detectable(d[None], TABLE)[0]
    assert seeds_needed(d, 1.0001 * measured, TABLE) == 4
    assert seeds_needed(d, 0.9999 * measured, TABLE) == 5


def test_noise_goes_away_with_seeds():
    noise = np.outer([1.0, -1.0, 1.0, -1.0], [1.0, -1.0] * 10)
    half = detectable(noise[None], TABLE)[0] / 2
    assert error(noise[None]).variances[:2].max() < 1e-12
    needed = seeds_needed(noise, half, TABLE)
    assert needed is not None
    assert 4 < needed <= 16


def test_no_number_of_seeds_makes_up_for_few_clips():
    d = differences(4, 4, 1, (1, 0, 10, 0, 0.1), tables=1)[0]
    assert seeds_needed(d, 3.0, TABLE) is None
