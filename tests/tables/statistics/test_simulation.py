"""Simulated differences have the variances that they are said to have."""

from __future__ import annotations

import numpy as np
import pytest

from memmlp.tables.statistics.crossed_seeds_and_groups import error
from memmlp.tables.statistics.simulation import SHARES, Shares, Simulated, SimulationSetting, draw


@pytest.mark.parametrize("cell", [SimulationSetting(5, 10, 1), SimulationSetting(5, 11, 2)])
def test_mixtures_are_those_of_whole_differences(cell: SimulationSetting):
    sample = Simulated(np.random.default_rng(3), cell, 24)
    rng = np.random.default_rng(3)
    of_seeds = np.sqrt(cell.seeds) * rng.normal(size=(24, cell.seeds))
    fixed, noise, _ = draw(rng, cell, 24)
    shares = Shares(1, 2, 3, 4, 5)
    weights = np.sqrt(np.array(shares) / 15)
    by_group = weights[0] * of_seeds[:, :, None] + weights[4] * noise
    by_group = by_group + np.einsum("i,kig->kg", weights[1:4], fixed)[:, None]
    differences = by_group[:, :, cell.groups]
    for seeds in (3, 5):
        known, mean = sample.mixed(shares, seeds)
        expected = error(differences[:, :seeds], cell.groups)
        np.testing.assert_allclose(known.variances, expected.variances)
        assert (known.seeds, known.groups) == (expected.seeds, expected.groups)
        np.testing.assert_allclose(mean, differences[:, :seeds].mean((1, 2)))


@pytest.mark.parametrize("name", SHARES)
def test_means_have_a_variance_of_one(name: str):
    sample = Simulated(np.random.default_rng(0), SimulationSetting(3, 11, 2), 24000)
    known, mean = sample.mixed(SHARES[name], 3)
    assert mean.var() == pytest.approx(1, abs=0.06)
    a, b, e = known.variances.mean(1)
    assert a + b - e == pytest.approx(1, abs=0.06 if SHARES[name].groups else 0.2)
