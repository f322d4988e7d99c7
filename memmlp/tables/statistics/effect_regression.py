"""A straight line through the effects of many cells, which share their test clips: random-effects regression.

The effect of cell i on the clips of group g is taken to be

    m[i, g] = x[i] . (beta + b[g]) + u[i] + noise,

where x[i] are the cell's covariates (1 and logarithms), beta is wanted, b[g] is the clips' own part, and u[i]
is the cell's own part: how far its expected effect is from a line, and the randomness of its trainings. A
cell's effect is the mean over groups, weighted by their shares w[g] of the clips. The coefficients are those
of weighted least squares with 1 / (n[i] + tau^2), where n[i] is the variance of the mean's noise and tau^2
that of u, which is found where the weighted squares of the residuals are as many as their degrees of freedom
(Paule and Mandel 1982, "Consensus values and weighting factors"; for regression Berkey et al. 1995, "A
random-effects regression model for meta-analysis").

Every number that is read from the line is a sum of the cells' effects with known factors c[i]. Its error has
two sides, which are crossed as seeds and clips are (`crossed_seeds_and_groups`), with cells in place of
seeds:

    A = sum of c^2 (n + tau^2)                                       K - P       (Knapp and Hartung 2003: t)
    B = variance of the groups' own sums x sum of w^2                G - 1
    E = sum of c^2 n, the noise, which is in both                    (K - P) (G - 1)

A meta-analysis of cells with their own standard errors would use A alone, and would count the clips that all
cells share as if each cell had different ones.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from memmlp.tables.statistics.crossed_seeds_and_groups import Error, Groups, by_group
from memmlp.tables.statistics.paired_differences import LEVEL

LEAST = 2
"""The least degrees of freedom of a fit: the number of cells minus the number of coefficients."""


class Estimate(NamedTuple):
    """Numbers (Q,) read from a line, the ends of their intervals, and p-values; NaN with one group."""

    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray
    p: np.ndarray


@dataclass(frozen=True)
class FittedLine:
    """Least squares through the effects of K cells.

    Attributes:
        means: the groups' means by cell (K, G).
        weights: each group's share of the clips (G,).
        x: the cells' covariates (K, P), which include a column of ones.
        noise: the variance n (K,) of the noise of each cell's effect.
        tau2: the variance tau^2 of the cells' own part.
    """

    means: np.ndarray
    weights: np.ndarray
    x: np.ndarray
    noise: np.ndarray = field(init=False)
    tau2: float = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "noise", self._noise())
        object.__setattr__(self, "tau2", self._between())

    @property
    def effects(self) -> np.ndarray:
        """The cells' effects (K,)."""
        return self.means @ self.weights

    @property
    def freedom(self) -> int:
        """K - P, the degrees of freedom."""
        return self.x.shape[0] - self.x.shape[1]

    def at(self, x: np.ndarray, level: float = LEVEL, another: bool = False) -> Estimate:
        """Return the line at covariates (Q, P), with intervals that miss with the probability `level`.

        Args:
            x: the covariates; a unit vector asks for its coefficient.
            level: the probability.
            another: whether the intervals are for the effect of one more cell at x, which is as far from the
                line and as noisy as these cells are; otherwise they are for the line.
        """
        mean, known = self._read(x, another)
        half = known.half(level)
        p = np.full_like(mean, np.nan) if known.conditional else known.level(np.abs(mean))
        return Estimate(mean, mean - half, mean + half, p)

    def interval(
        self, x: np.ndarray, level: float = LEVEL, another: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the ends (Q,) of the intervals of `at`, without the p-values, which take the longest."""
        mean, known = self._read(x, another)
        half = known.half(level)
        return mean - half, mean + half

    def _read(self, x: np.ndarray, another: bool) -> tuple[np.ndarray, Error]:
        """Return the line at covariates (Q, P), with its error."""
        factors = self._factors(np.atleast_2d(x))
        return factors @ self.effects, self._error(factors, another)

    def slope(self, column: int) -> Estimate:
        """Return the coefficient of a column of the covariates, as arrays of one."""
        return self.at(np.eye(self.x.shape[1])[column])

    def _factors(self, x: np.ndarray) -> np.ndarray:
        """Return the factors c (Q, K) with which the cells' effects add up to the line at x (Q, P)."""
        return x @ _solver(self.x, self._spread(self.tau2))

    def _error(self, factors: np.ndarray, another: bool) -> Error:
        squares, several = factors**2, self.means.shape[1] > 1
        cells = squares @ self._spread(self.tau2)
        cells = cells + (self.tau2 + self.noise.mean() if another else 0)
        none = np.zeros(len(factors))
        share = self.weights @ self.weights
        clips = (factors @ self.means).var(1, ddof=1) * share if several else none
        noise = squares @ self.noise if several else none
        groups = max(self.means.shape[1] - 1, 1)
        return Error(np.stack([cells, clips, noise]), self.freedom, groups, "" if several else "clips")

    def _spread(self, tau2: float) -> np.ndarray:
        """Return n + tau^2 (K,); if no cell differs from the line at all, equal numbers close to 0."""
        spread = self.noise + tau2
        return np.maximum(spread, max(1e-9 * spread.max(), np.finfo(float).tiny))

    def _noise(self) -> np.ndarray:
        """Return the variance n (K,) that neither the clips' own lines nor the cell's mean explains.

        A residual of least squares has less variance than the true deviation, by the cell's leverage; this is
        corrected.
        """
        if self.means.shape[1] < 2:
            return np.zeros(len(self.means))
        hat = self.x @ _solver(self.x, np.ones(len(self.x)))
        rest = self.means - hat @ self.means
        left = np.maximum(1 - np.diag(hat), 1e-9)
        return rest.var(1, ddof=1) * (self.weights @ self.weights) / left

    def _between(self) -> float:
        """Return tau^2; 0 if the noise explains the residuals."""
        alike = self._residuals(np.ones(len(self.x)))
        most = float(alike @ alike) / self.freedom  # there is no more at this end than degrees of freedom
        if most <= 0 or (self.noise.min() > 0 and self._excess(0.0) <= 0):
            return 0.0
        return most if self._excess(most) >= 0 else float(brentq(self._excess, 0.0, most, rtol=1e-9))

    def _excess(self, tau2: float) -> float:
        spread = self._spread(tau2)
        return float((self._residuals(spread) ** 2 / spread).sum()) - self.freedom

    def _residuals(self, spread: np.ndarray) -> np.ndarray:
        return self.effects - self.x @ (_solver(self.x, spread) @ self.effects)


def _solver(x: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Return the matrix (P, K) of least squares with weights 1 / spread: from values to coefficients."""
    root = np.sqrt(spread.min() / spread)
    return np.linalg.pinv(x * root[:, None]) * root


def fit(differences: np.ndarray, x: np.ndarray, groups: Groups = None) -> FittedLine | None:
    """Fit a line to the differences (K, C) of K cells on the same clips, each the mean over its seeds.

    Args:
        differences: the cells' differences from their controls.
        x: the cells' covariates (K, P), which include a column of ones.
        groups: the clips' groups (C,).

    Returns:
        The line; None if there are too few cells, or if they differ too little.
    """
    cells, coefficients = x.shape
    if cells - coefficients < LEAST or np.linalg.matrix_rank(x) < coefficients:
        return None
    means, weights = by_group(differences[:, None], groups)
    return FittedLine(means[:, 0], weights, x)
