"""Mean, interval and p-value of differences that are paired by seed and clip."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from memmlp.statistics.crossed import Groups, error

LEVEL = 0.05


class Effects(NamedTuple):
    """Of K comparisons, each (K,): mean difference, its 95 % interval and p-value; NaN where there is none.

    `conditional` is what interval and mean can't speak of, because there is one alone: "seeds", "clips" (one
    group of them), "seeds and clips", or "". Where it isn't empty there are no p-values.
    """

    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray
    p: np.ndarray
    conditional: str


def paired_effects(differences: np.ndarray, groups: Groups = None) -> Effects:
    """Effects of differences (K, S, C) over seeds and clips, whose groups (C,) are what was replicated.

    Interval and p-value are one thing: 0 lies outside exactly where p is at most 0.05.
    """
    mean, known = differences.mean((1, 2)), error(differences, groups)
    nothing = np.full_like(mean, np.nan)
    half = nothing if known.conditional == "seeds and clips" else known.half(LEVEL)
    p = nothing if known.conditional else known.level(np.abs(mean))
    return Effects(mean, mean - half, mean + half, p, known.conditional)


def equivalence_p(differences: np.ndarray, margin: float | np.ndarray, groups: Groups = None) -> np.ndarray:
    """P-values (K,) of the claim that means of differences (K, S, C) lie within +-margin, () or (K,).

    The level at which the interval just lies within. Two one-sided tests would do with the interval of twice
    that level (Schuirmann 1987), so this is on the safe side, and it agrees with the interval that is shown.
    NaN with one seed or one group.
    """
    known = error(differences, groups)
    if known.conditional:
        return np.full(len(differences), np.nan)
    return known.level(margin - np.abs(differences.mean((1, 2))))
