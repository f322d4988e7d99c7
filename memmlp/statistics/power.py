"""What a table could have seen: effects found in four of five repetitions, and the seeds that takes."""

from __future__ import annotations

import bisect
import functools

import numpy as np
from scipy.special import chdtri, ndtri

from memmlp.statistics.crossed import Error, Groups, error
from memmlp.statistics.effects import LEVEL

DRAWS = 4096  # of the error and its estimate; a power of two, for Sobol's sequence


def detectable(
    differences: np.ndarray, comparisons: int, groups: Groups = None, power: float = 0.8
) -> np.ndarray:
    """Effects (K,) that tables like these differences (K, S, C) would call significant with this power.

    At the first, strictest step of Holm's correction over so many comparisons. The variances that were
    measured are taken for the true ones, all effects for normal. NaN with one seed or one group.
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
    """The fewest seeds with which this effect would be found, by one comparison's differences (S, C).

    As `detectable`, the shares of seeds and noise divided by the seeds. None where not even `most` would do,
    because the groups of clips are too few or too unlike, and with one seed or one group.
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
    """The shares (3, K) of seeds, groups and noise in the means' variances."""
    seeds, groups, noise = known.variances
    return np.stack([np.maximum(seeds - noise, 0), np.maximum(groups - noise, 0), noise])


def found(parts: np.ndarray, seeds: int, groups: float, level: float, power: float) -> np.ndarray:
    """Effects (K,) found at this level with this power, where the variance has these parts (3, K).

    An effect is found where it and the mean's error exceed half the interval's width. So it is a quantile
    of that half less the error, over tables drawn with these variances and with `groups` degrees of freedom.
    """
    z, estimates = _draws(seeds, groups)
    true = parts + parts[2] * [[1], [1], [0]]  # A and B hold the noise
    drawn = (true[:, :, None] * estimates[:, None]).reshape(3, -1)
    half = Error(drawn, seeds - 1, groups).half(level).reshape(-1, DRAWS)
    return np.quantile(half - np.sqrt(parts.sum(0))[:, None] * z, power, axis=1)


@functools.cache
def _draws(seeds: int, groups: float) -> tuple[np.ndarray, np.ndarray]:
    """Standard normal errors (DRAWS,), and A, B and E over their expectations (3, DRAWS)."""
    from scipy.stats import qmc  # slow to import, as is all of scipy.stats

    uniform = qmc.Sobol(4, seed=0).random(DRAWS).T
    freedoms = np.array([[seeds - 1], [groups], [(seeds - 1) * groups]])
    return ndtri(uniform[0]), chdtri(freedoms, uniform[1:]) / freedoms
