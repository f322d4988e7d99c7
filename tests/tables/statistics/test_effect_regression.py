"""A line through cells that share their clips: its numbers, and how often its intervals are right."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from memmlp.tables.statistics.crossed_seeds_and_groups import error
from memmlp.tables.statistics.effect_regression import FittedLine, fit
from memmlp.tables.statistics.paired_differences import paired_effects

STEPS = np.array([500, 1000, 2000, 2000, 2000, 2000, 4000, 8000, 2000, 2000, 2000])
WIDTH = np.array([128, 128, 128, 64, 256, 512, 128, 128, 128, 128, 128])
DATA = np.array([1, 1, 1, 1, 1, 1, 1, 1, 0.5, 0.25, 0.125])
COMPUTE = np.log10(STEPS * WIDTH**1.9)
X = np.stack([np.ones(11), COMPUTE, np.log10(DATA)], 1)  # the cells of sweeps/scaling.yaml
ASKED = np.array([[1, COMPUTE.min(), 0], [1, COMPUTE.mean(), 0], [1, COMPUTE.max() + 3, 0], [0, 1, 0]])
KINDS = {"cells": (0, 0.3, 0.01), "mixed": (1, 0.3, 1), "noise and cells": (0, 0.2, 1), "clips": (1, 0, 0.01)}
"""What there is of the clips' own lines, the cells' own parts, and noise."""


def drawn(rng: np.random.Generator, clips: float, cells: float, noise: float, groups: int) -> np.ndarray:
    """Draw differences (11, groups) around 0.

    The noise is three times as large in the cells of the least compute as in those of the most.
    """
    scale = 3 ** (1 - (COMPUTE - COMPUTE.min()) / np.ptp(COMPUTE))
    own = clips * (X - X.mean(0) + [1, 0, 0]) @ rng.normal(size=(3, groups))
    return own + cells * rng.normal(size=(11, 1)) + noise * scale[:, None] * rng.normal(size=(11, groups))


def coverage(kind: str, groups: int, tables: int, seed: int = 7) -> tuple[np.ndarray, np.ndarray]:
    """Return how often the band has the true line, 0, and the wider interval one more cell's effect."""
    rng = np.random.default_rng(seed)
    own, noise = KINDS[kind][1], KINDS[kind][2] * np.sqrt(3 / groups)
    within = np.zeros((2, len(ASKED)))
    for _ in range(tables):
        line = fit(drawn(rng, *KINDS[kind], groups), X)
        assert line is not None
        more = rng.normal(size=len(ASKED)) * np.hypot(own, noise)
        for found, another, true in zip(within, (False, True), (0, more), strict=True):
            low, high = line.interval(ASKED, another=another)
            found += (low <= true) & (true <= high)
    return 100 * within[0] / tables, 100 * within[1] / tables


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["cells", "mixed", "noise and cells"])
def test_intervals_of_95_percent_miss_one_in_twenty(kind: str):
    band, another = coverage(kind, groups=200, tables=400)
    assert band.min() >= 92
    assert band.max() <= 98
    assert another[:3].min() >= 92


def test_cells_that_share_clips_are_not_taken_for_cells_of_other_clips():
    """With a meta-analysis' side alone the clips' own lines would be missed, which all cells share."""
    band, _ = coverage("clips", groups=54, tables=60)
    assert band.min() >= 90
    rng, alone = np.random.default_rng(7), []
    for _ in range(60):
        line = fit(drawn(rng, *KINDS["clips"], 54), X)
        factors = line._factors(ASKED)
        half = stats.t.isf(0.025, line.freedom) * np.sqrt(factors**2 @ line._spread(line.tau2))
        alone.append(np.abs(factors @ line.effects) <= half)
    assert 100 * np.mean(alone, 0).min() < 30


def test_one_group_of_clips_is_a_regression_of_the_means():
    """With nothing known of noise the cells count alike, and the interval is that of least squares."""
    rng = np.random.default_rng(0)
    y = 0.3 * COMPUTE + rng.normal(size=11)
    line = fit(y[:, None], X[:, :2])
    textbook = stats.linregress(COMPUTE, y)
    slope = line.slope(1)
    half = stats.t.isf(0.025, 9) * textbook.stderr
    assert slope.mean[0] == pytest.approx(textbook.slope)
    assert line.interval(np.array([0, 1])) == (slope.low, slope.high)
    assert (slope.low[0], slope.high[0]) == pytest.approx((textbook.slope - half, textbook.slope + half))
    assert np.isnan(slope.p[0])
    there = line.at(np.array([1, 20.0]), another=True)
    far = 1 + 1 / 11 + (20 - COMPUTE.mean()) ** 2 / np.sum((COMPUTE - COMPUTE.mean()) ** 2)
    spread = textbook.stderr * np.sqrt(np.sum((COMPUTE - COMPUTE.mean()) ** 2))
    assert there.high[0] - there.mean[0] == pytest.approx(stats.t.isf(0.025, 9) * spread * np.sqrt(far))


def test_coefficients_are_those_of_the_normal_equations():
    """And the residuals' weighted squares are as many as their degrees of freedom, which defines tau^2."""
    line = fit(drawn(np.random.default_rng(1), 0.3, 1.5, 2, 30), X)
    variance = line.noise + line.tau2
    information = X.T @ np.diag(1 / variance) @ X
    beta = np.linalg.solve(information, X.T @ (line.effects / variance))
    assert line.tau2 > 0
    assert line.at(np.eye(3)).mean == pytest.approx(beta)
    assert np.sum((line.effects - X @ beta) ** 2 / variance) == pytest.approx(11 - 3)
    factors = line._factors(np.eye(3))
    assert line._error(factors, False).variances[0] == pytest.approx(np.diag(np.linalg.inv(information)))


def test_no_difference_between_cells_beyond_noise_is_none():
    quiet = np.random.default_rng(3).normal(size=(11, 400))
    assert fit(quiet - quiet.mean(1, keepdims=True), X).tau2 == 0
    assert fit(np.zeros((11, 5)), X).at(ASKED).mean == pytest.approx(np.zeros(4))


def test_a_constant_of_equal_cells_is_the_mean_of_seeds():
    """Cells without covariates are what seeds are in a table: the same three variances."""
    d = np.random.default_rng(4).normal(size=(12, 3000)) + np.random.default_rng(5).normal(size=(12, 1))
    line, table = fit(d, np.ones((12, 1))), error(d[None])
    mine = line._error(line._factors(np.ones((1, 1))), False)
    assert mine.variances[:, 0] == pytest.approx(table.variances[:, 0], rel=0.03)
    assert (mine.seeds, mine.groups) == (table.seeds, table.groups)
    effects = paired_effects(d[None])
    assert line.at(np.ones(1)).high[0] == pytest.approx(effects.high[0], abs=0.02)


def test_groups_of_clips_count_by_their_clips():
    d = np.random.default_rng(6).normal(size=(11, 6))
    groups = np.array([0, 0, 0, 1, 2, 2])
    line = fit(d, X, groups)
    assert isinstance(line, FittedLine)
    assert line.effects == pytest.approx(d.mean(1))
    assert line.means.shape == (11, 3)


@pytest.mark.parametrize("x", [X[[0, 5, 8, 9]], X[:8], np.ones((11, 2))])
def test_too_few_or_too_similar_cells_have_no_line(x: np.ndarray):
    assert fit(np.random.default_rng(0).normal(size=(len(x), 5)), x) is None
