"""The error of a mean over seeds and groups of clips that were crossed: every seed saw every clip.

d[s, c] = mean + effect of seed s + effect of c's group + effect of clip c + noise, in unknown shares. Clips are
first averaged within their groups (takes, subjects), which are what was replicated; the mean stays that over
clips, so that a group weighs as much as it has clips. With the means of groups m[s, g] and weights w[g]

    A = variance of the S seeds' means / S,                                      S - 1 degrees of freedom
    B = spread of the groups' means around their mean, weighted,                 m, which is G - 1 where balanced
    E = the same spread of what neither seed nor group explains, / S,            (S - 1) m

and A + B - E estimates the variance of the mean, because the noise is in A and in B.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize.elementwise import find_root
from scipy.special import stdtr, stdtrit

Groups = np.ndarray | Sequence[object] | None
"""The group of each clip (C,), as integers or labels; None: each clip is its own."""


@dataclass(frozen=True)
class Error:
    """What is known of the errors of K means.

    Args:
        variances: A, B and E of the module's text, (3, K); a side with one member alone is 0, and so is E then.
        freedoms: their degrees of freedom (3, 1).
        conditional: what has one member alone, so that nothing can be said of others: "seeds", "clips",
            "seeds and clips", or "" where there are several of both.
    """

    variances: np.ndarray
    freedoms: np.ndarray
    conditional: str

    def half(self, level: float | np.ndarray) -> np.ndarray:
        """Half the width (K,) of the intervals that miss with a probability of at most `level`, () or (K,).

        Each side has the quantile of its own degrees of freedom, and then their squares add (Banerjee 1960,
        "Approximate confidence interval for linear functions of means of k populations"): no sample of few
        seeds whose variances happen to look good can pass for a large one, as it does with Satterthwaite's
        degrees of freedom. The noise, which both sides hold, is taken off once, but never more than leaves
        the wider of the two alone.
        """
        seeds, groups, noise = stdtrit(self.freedoms, np.asarray(level) / 2) ** 2 * self.variances
        return np.sqrt(np.maximum(np.maximum(seeds, groups), seeds + groups - noise))

    def level(self, distance: np.ndarray) -> np.ndarray:
        """The level (K,) at which `half` is this distance (K,); 1 for 0 and below."""
        levels = np.where(distance > 0, self._one_side(distance), 1.0)
        # Both sides together are at most twice the wider one, squared: the root is between these two.
        most = self._one_side(distance / np.sqrt(2))
        open_ = np.flatnonzero((distance > 0) & (levels > 0) & (self.half(levels) > distance * (1 + 1e-9)))
        if open_.size:
            bracket = np.log(levels[open_]), np.log(most[open_])
            args = (distance[open_], *self.variances[:, open_])
            levels[open_] = np.exp(find_root(self._excess, bracket, args=args).x)
        return levels

    def _one_side(self, distance: np.ndarray) -> np.ndarray:
        """The larger of Student's p-values of the sides of seeds and of groups."""
        sides = self.variances[:2]
        t = np.divide(distance, np.sqrt(sides), out=np.full(sides.shape, np.inf), where=sides > 0)
        return np.max(2 * stdtr(self.freedoms[:2], -t), 0)

    def _excess(
        self, log: np.ndarray, distance: np.ndarray, a: np.ndarray, b: np.ndarray, e: np.ndarray
    ) -> np.ndarray:
        part = Error(np.stack([a, b, e]), self.freedoms, "")
        return (part.half(np.exp(log)) / distance) ** 2 - 1


def error(differences: np.ndarray, groups: Groups = None) -> Error:
    """The error of the means of differences (K, S, C) over seeds and clips."""
    return error_by_group(*by_group(differences, groups))


def error_by_group(means: np.ndarray, weights: np.ndarray) -> Error:
    """The same from the means of groups (K, S, G) and their shares of the clips (G,)."""
    seeds, clips = means.shape[1] > 1, len(weights) > 1
    a = means @ weights
    b = means.mean(1)
    none = np.zeros(len(means))
    variances = np.stack([
        a.var(1, ddof=1) / a.shape[1] if seeds else none,
        spread(b, weights) if clips else none,
        _noise(means - b[:, None], weights) if seeds and clips else none,
    ])  # fmt: skip
    single = [name for name, several in (("seeds", seeds), ("clips", clips)) if not several]
    return Error(variances, freedoms(means.shape[1], weights), " and ".join(single))


def by_group(differences: np.ndarray, groups: Groups = None) -> tuple[np.ndarray, np.ndarray]:
    """Means of differences (K, S, C) over the clips of each group (K, S, G), and the groups' shares of clips (G,)."""
    clips = differences.shape[2]
    if groups is None:
        return differences, np.full(clips, 1 / clips)
    _, index, sizes = np.unique(np.asarray(groups), return_inverse=True, return_counts=True)
    starts = np.cumsum(sizes) - sizes
    sums = np.add.reduceat(differences[:, :, np.argsort(index, kind="stable")], starts, axis=2)
    return sums / sizes, sizes / clips


def spread(means: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Estimated variance (...) of the weighted mean of groups' means (..., G), without bias where theirs are equal."""
    deviations = means - (means @ weights)[..., None]
    return deviations**2 @ _factors(weights)


def _noise(rest: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Estimated variance (K,) that noise adds to the mean, from what no group's mean explains (K, S, G)."""
    seeds = rest.shape[1]
    return spread(rest, weights).sum(1) / (seeds * (seeds - 1))


def _factors(weights: np.ndarray) -> np.ndarray:
    """What squared deviations from the weighted mean count in `spread`, (G,)."""
    return weights**2 / (1 - 2 * weights + weights @ weights)


def freedoms(seeds: int, weights: np.ndarray) -> np.ndarray:
    """Degrees of freedom (3, 1) of the three variances; 1 where there is none.

    Effects of clips may be skewed, and the t of few skewed values has heavier tails than Student's. What
    Student's degrees of freedom give the tail of exponential values, is 0.9 m^0.6 or a little more at levels
    from 0.05 to 0.0005 and for 2 to 536 of them (docs/statistics.md), and so these are taken for groups. An
    effect of a seed is a sum of many small ones, and taken as normal.
    """
    m = satterthwaite(weights) if len(weights) > 1 else 1.0
    return np.array([[max(seeds - 1, 1)], [min(m, 0.9 * m**0.6)], [max(seeds - 1, 1) * m]])


def satterthwaite(weights: np.ndarray) -> float:
    """Degrees of freedom of `spread`, G - 1 for equal weights (Satterthwaite 1946; of a quadratic form M: tr(M)^2 / tr(M^2))."""
    factors = _factors(weights)
    products = np.eye(len(weights)) - weights[:, None] - weights + weights @ weights
    return float((factors @ products.diagonal()) ** 2 / (factors @ products**2 @ factors))
