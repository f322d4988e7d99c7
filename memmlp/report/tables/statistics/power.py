"""What a table could have found: effects that four of five tables find, and the seeds that they need."""

from __future__ import annotations

import bisect
import functools

import numpy as np
from scipy.special import chdtri, ndtri

from memmlp.report.tables.statistics.paired_differences import LEVEL, Error, Groups, error

DRAWS = 4096  # simulated tables; a power of two, as Sobol's sequence wants


def detectable(
    differences: np.ndarray, comparisons: int, groups: Groups = None, power: float = 0.8
) -> np.ndarray:
    """Return the effects (K,) that tables like these differences (K, S, C) would find with this power.

    "Find" means to call significant at the first, strictest step of Holm's correction over `comparisons`. The
    measured variances are taken as the true ones, and all effects as normal. The result is NaN with one seed
    or one group.
    """
    known = error(differences, groups)
    if known.conditional:
        return np.full(len(differences), np.nan)
    return found(components(known), differences.shape[1], known.groups, LEVEL / comparisons, power)


def seeds_needed(
    differences: np.ndarray,
    effect: float,
    comparisons: int,
    groups: Groups = None,
    power: float = 0.8,
    most: int = 1000,
) -> int | None:
    """Return the fewest seeds with which this effect would be found, estimated from differences (S, C).

    It is computed as in `detectable`, with the parts of seeds and noise divided by the number of seeds.

    Args:
        differences: the differences of one comparison (S, C).
        effect: the effect to be found, in the unit of the differences.
        comparisons: how many comparisons Holm's correction is over.
        groups: the group of each clip (C,).
        power: the share of tables in which the effect is to be found.
        most: the largest number of seeds to consider.

    Returns:
        The number; None if not even `most` seeds are enough, because the groups of clips are too few or too
        different, and with one seed or one group.
    """
    matrix = differences.reshape(1, *differences.shape[-2:])
    known = error(matrix, groups)
    if known.conditional:
        return None

    def enough(seeds: int) -> bool:
        share = matrix.shape[1] / seeds
        parts = components(known) * [[share], [1], [share]]
        return bool(found(parts, seeds, known.groups, LEVEL / comparisons, power)[0] <= abs(effect))

    if not enough(most):
        return None
    return bisect.bisect_left(range(most), True, lo=2, key=enough)


def components(known: Error) -> np.ndarray:
    """Return the parts (3, K) of seeds, groups and noise in the variances of the means."""
    seeds, groups, noise = known.variances
    return np.stack([np.maximum(seeds - noise, 0), np.maximum(groups - noise, 0), noise])


def found(parts: np.ndarray, seeds: int, groups: float, level: float, power: float) -> np.ndarray:
    """Return the effects (K,) that are found at this level with this power.

    An effect is found if it exceeds half the width of the interval minus the error of the mean. So the result
    is a quantile of that difference over simulated tables.

    Args:
        parts: the true parts (3, K) of seeds, groups and noise in the variance of the mean.
        seeds: the number of seeds.
        groups: degrees of freedom of B.
        level: the level of the test.
        power: the share of tables in which the effect is to be found.
    """
    z, estimates = _draws(seeds, groups)
    true = parts + parts[2] * [[1], [1], [0]]  # the estimates A and B both contain the noise
    drawn = (true[:, :, None] * estimates[:, None]).reshape(3, -1)
    half = Error(drawn, seeds - 1, groups).half(level).reshape(-1, DRAWS)
    return np.quantile(half - np.sqrt(parts.sum(0))[:, None] * z, power, axis=1)


@functools.cache
def _draws(seeds: int, groups: float) -> tuple[np.ndarray, np.ndarray]:
    """Draw the random quantities that vary between tables.

    Returns:
        Standard normal errors of the mean (DRAWS,), and estimates of A, B and E divided by their expectations
        (3, DRAWS), which are chi-squared over their degrees of freedom.
    """
    from scipy.stats import qmc  # slow to import, as is all of scipy.stats

    uniform = qmc.Sobol(4, seed=0).random(DRAWS).T
    freedoms = np.array([[seeds - 1], [groups], [(seeds - 1) * groups]])
    return ndtri(uniform[0]), chdtri(freedoms, uniform[1:]) / freedoms
