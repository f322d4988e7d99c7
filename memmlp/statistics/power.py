"""What a table could have seen: effects found in four of five repetitions, and the seeds that takes."""

from __future__ import annotations

import functools

import numpy as np
from scipy.special import chdtri, ndtri
from scipy.stats import qmc

from memmlp.statistics.crossed import Error, Groups, by_group, error, freedoms, satterthwaite
from memmlp.statistics.effects import LEVEL

DRAWS = 4096  # of the error and its estimate; a power of two, for Sobol's sequence


def detectable(
    differences: np.ndarray, comparisons: int, groups: Groups = None, power: float = 0.8
) -> np.ndarray:
    """Effects (K,) that tables like these differences (K, S, C) would call significant with this power.

    At the first, strictest step of Holm's correction over so many comparisons. The variances that were
    measured are taken for the true ones, effects of groups for normal. NaN with one seed or one group.
    """
    known = error(differences, groups)
    if known.conditional:
        return np.full(len(differences), np.nan)
    _, weights = by_group(differences, groups)
    return _detectable(components(known), differences.shape[1], weights, LEVEL / comparisons, power)


def seeds_needed(
    differences: np.ndarray,
    effect: float,
    comparisons: int,
    groups: Groups = None,
    power: float = 0.8,
    most: int = 1000,
) -> int | None:
    """The fewest seeds with which this effect would be found, by one comparison's differences (S, C).

    As `detectable`, with the seeds' and the noise's share of the variance divided by the seeds. None where not
    even `most` would do, because the groups of clips are too few or too unlike, and where one seed or one
    group tells nothing.
    """
    known = error(differences.reshape(1, *differences.shape[-2:]), groups)
    if known.conditional:
        return None
    _, weights = by_group(differences.reshape(1, *differences.shape[-2:]), groups)

    def enough(seeds: int) -> bool:
        share = differences.shape[-2] / seeds
        parts = components(known) * np.array([[share], [1], [share]])
        return bool(_detectable(parts, seeds, weights, LEVEL / comparisons, power)[0] <= abs(effect))

    if not enough(most):
        return None
    few, many = 1, most  # one seed alone never decides
    while many - few > 1:
        middle = (few + many) // 2
        few, many = (few, middle) if enough(middle) else (middle, many)
    return many


def components(known: Error) -> np.ndarray:
    """The share (3, K) of seeds, of groups and of noise in the means' variances."""
    seeds, groups, noise = known.variances
    return np.stack([np.maximum(seeds - noise, 0), np.maximum(groups - noise, 0), noise])


def _detectable(
    parts: np.ndarray, seeds: int, weights: np.ndarray, level: float, power: float
) -> np.ndarray:
    """Effects (K,) found at this level with this power where the variance has these parts (3, K).

    An effect is found where it and the mean's error are more than half the interval's width. So it is the
    quantile of half the width less the error, over tables drawn with these variances.
    """
    z, estimates = _draws(seeds, float(satterthwaite(weights)))
    seeds_, groups, noise = parts[:, :, None] + np.stack([parts[2], parts[2], 0 * parts[2]])[:, :, None]
    drawn = np.stack(np.broadcast_arrays(seeds_, groups, noise)) * estimates[:, None]
    half = Error(drawn.reshape(3, -1), freedoms(seeds, weights), "").half(level).reshape(len(parts[0]), -1)
    return np.quantile(half - np.sqrt(parts.sum(0))[:, None] * z, power, axis=1)


@functools.cache
def _draws(seeds: int, groups: float) -> tuple[np.ndarray, np.ndarray]:
    """Standard normal errors (DRAWS,) and what the three variances are estimated to be of the true, (3, DRAWS)."""
    uniform = qmc.Sobol(4, seed=0).random(DRAWS).T
    true = np.array([[seeds - 1], [groups], [(seeds - 1) * groups]])
    return ndtri(uniform[0]), chdtri(true, uniform[1:]) / true
