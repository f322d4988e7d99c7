"""The error of a mean over seeds and groups of clips."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from drawn import TABLE
from scipy import stats
from scipy.special import stdtrit

from memmlp.tables.statistics.crossed_seeds_and_groups import error, skewed


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


def test_the_example_of_the_documentation():
    """Each of its numbers follows from its table."""
    page = (Path(__file__).parents[3] / "docs/statistics.md").read_text()
    example = page[page.index("**An example**") : page.index("## The error of a mean")]
    rows = [[float(cell) for cell in row.split("|")[2:8]] for row in re.findall(r"\| seed .*", example)]
    table = np.array(rows)
    differences = table[:, :5]
    assert table[:, 5] == pytest.approx(differences.mean(1))
    known = error(differences[None])
    a, b, _ = np.sqrt(known.variances[:, 0])
    t_seeds, t_groups = (-stdtrit(df, 0.025) for df in (2, skewed(4)))
    (p,) = known.level(np.abs(differences.mean(keepdims=True)[0]))
    seeds, groups = a * t_seeds, b * t_groups
    mean, half = differences.mean(), known.half(0.05)[0]
    columns = " | ".join(f"{x:.2f}" for x in (*differences.mean(0), mean))
    for words in (
        f"standard deviation of {differences.mean(1).std(ddof=1):.2f}.",
        f"= {a:.3f} (√A",
        f"is {t_seeds:.1f}. That side of the interval is ± {seeds:.2f}.",
        f"vary with {differences.mean(0).std(ddof=1):.2f}; of five",
        f"= {b:.3f} (√B",
        f"t is {t_groups:.1f} and not {-stdtrit(4, 0.025):.1f}. That side is ± {groups:.2f}.",
        f"√({seeds:.2f}² + {groups:.2f}²)",
        f"**{mean:.2f} ± {half:.2f} cm**, p = {p:.3f}",
        f"| mean | {columns} |",
    ):
        assert words in " ".join(example.split()), words
    assert 0.05 / 10 < p < 0.05
