"""The error of a mean over seeds and groups of clips that were crossed: every seed saw every clip.

d[s, c] = mean + effect of seed s + effect of c's group + effect of clip c + noise, in unknown shares. Clips
are first averaged within their groups (takes, subjects), which are what was replicated; the mean stays that
over clips, so that a group weighs w[g], its share of the clips. The means m[s, g] give three variances,

    A = variance of the S seeds' means / S                                    S - 1 degrees of freedom
    B = variance of the G groups' means x sum of w^2                          G - 1
    E = variance of what neither explains x sum of w^2 / S                    (S - 1) (G - 1)

and A + B - E estimates that of the mean, because the noise is in A and in B. (Where groups differ in size,
and clips more than groups, B is larger than it should be; it is never smaller.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtr, stdtrit

Groups = np.ndarray | Sequence[object] | None
"""The group of each clip (C,), as integers or labels; None: each clip is its own."""


TRUST = 5.0
"""How much of the noise may be taken out of B as not skewed, by level: measured, see `Error.half`."""


@dataclass(frozen=True)
class Error:
    """What is known of the errors of K means.

    Args:
        variances: A, B and E of the module's text, (3, K); a side with one member is 0, and so is E then.
        seeds, groups: degrees of freedom of A and of B.
        conditional: what has one member alone, so that nothing can be said of others: "seeds", "clips",
            "seeds and clips", or "" where there are several of both.
    """

    variances: np.ndarray
    seeds: float
    groups: float
    conditional: str = ""

    def half(self, level: float | np.ndarray) -> np.ndarray:
        """Half the width (K,) of the intervals that miss with a probability of at most `level`, () or (K,).

        Each side has Student's quantile of its own degrees of freedom, and then their squares add (Banerjee
        1960): three seeds that happen to agree can't pass for many, as they do by Satterthwaite's. The noise,
        which is in both sides, counts once, with the larger quantile, and no less than in either side alone.

        Effects of groups may be `skewed`, noise is not. But B that is no more than noise may also be of few
        skewed values that happen to be alike, and the smaller the level the more so; so the lighter quantile
        is for that share of the noise alone which simulations allow (none with two groups).
        """
        level = np.asarray(level)
        a, b, e = self.variances
        seeds, groups, heavy = (_squared(df, level) for df in (self.seeds, self.groups, skewed(self.groups)))
        light = np.minimum(b, np.minimum(1, TRUST * level) * e) if self.groups > 1 else 0.0
        a, b = seeds * a, groups * light + heavy * (b - light)
        return np.sqrt(np.maximum(np.maximum(a, b), a + b - np.minimum(seeds, groups) * e))

    def level(self, distance: np.ndarray) -> np.ndarray:
        """The level (K,) at which `half` is this distance (K,); 1 for 0 and below, NaN for what is no number.

        An error without a number, of a network that diverged, is evidence of nothing.
        """
        from scipy.optimize.elementwise import find_root  # slow to import

        # The wider side alone, at its lightest, is too narrow; twice its square, at its heaviest, too wide.
        levels = np.where(distance > 0, self._wider(distance, self.groups), 1.0)
        most = self._wider(distance / 1.42, skewed(self.groups))
        unsure = np.flatnonzero((distance > 0) & (levels > 0))
        args = (distance[unsure], *self.variances[:, unsure])
        wider = self._excess(np.log(levels[unsure]), *args) > 1e-9
        if wider.any():
            unsure, args = unsure[wider], tuple(part[wider] for part in args)
            bracket = np.log(levels[unsure]), np.log(most[unsure])
            levels[unsure] = np.exp(find_root(self._excess, bracket, args=args).x)
        return np.where(np.isfinite(distance + self.variances.sum(0)), levels, np.nan)

    def _wider(self, distance: np.ndarray, groups: float) -> np.ndarray:
        """The larger of the p-values (K,) of the two sides by themselves."""
        sides = self.variances[:2]
        t = np.divide(distance, np.sqrt(sides), out=np.full(sides.shape, np.inf), where=sides > 0)
        return np.maximum(2 * stdtr(self.seeds, -t[0]), 2 * stdtr(groups, -t[1]))

    def _excess(self, log_level: np.ndarray, distance: np.ndarray, *variances: np.ndarray) -> np.ndarray:
        half = Error(np.stack(variances), self.seeds, self.groups).half(np.exp(log_level))
        return (half / distance) ** 2 - 1


def _squared(freedom: float, level: np.ndarray) -> np.ndarray:
    """Student's two-sided quantile, squared."""
    return stdtrit(freedom, level / 2) ** 2


def skewed(freedom: float) -> float:
    """Student's degrees of freedom whose tails are those of the t of values as skewed as exponential ones.

    A mean of few skewed values that all are small looks surer than it is. Measured for 2 to 536 of them, at
    levels from 0.05 to 0.0005, it is 0.9 m^0.6 or a few more of m = n - 1 (docs/statistics.md). Clips may
    be like that; an effect of a seed is a sum of many small ones, and taken as normal.
    """
    return min(freedom, 0.9 * freedom**0.6)


def error(differences: np.ndarray, groups: Groups = None) -> Error:
    """The error of the means of differences (K, S, C) over seeds and clips."""
    means, weights = by_group(differences, groups)
    _, s, g = means.shape
    none = np.zeros(len(means))
    a = (means @ weights).var(1, ddof=1) / s if s > 1 else none
    b = means.mean(1).var(1, ddof=1) * (weights @ weights) if g > 1 else none
    e = noise(means, weights) if s > 1 and g > 1 else none
    single = " and ".join(name for name, number in (("seeds", s), ("clips", g)) if number == 1)
    return Error(np.stack([a, b, e]), max(s - 1, 1), max(g - 1, 1), single)


def by_group(differences: np.ndarray, groups: Groups = None) -> tuple[np.ndarray, np.ndarray]:
    """Means of differences (K, S, C) over each group's clips (K, S, G), and its share of clips (G,)."""
    clips = differences.shape[2]
    if groups is None:
        return differences, np.full(clips, 1 / clips)
    _, index, sizes = np.unique(np.asarray(groups), return_inverse=True, return_counts=True)
    starts = np.cumsum(sizes) - sizes
    sums = np.add.reduceat(differences[:, :, np.argsort(index, kind="stable")], starts, axis=2)
    return sums / sizes, sizes / clips


def noise(means: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """E (K,) of means of groups (K, S, G)."""
    seeds = means.shape[1]
    rest = means - means.mean(1, keepdims=True)
    return rest.var(2, ddof=1).sum(1) * (weights @ weights) / (seeds * (seeds - 1))
