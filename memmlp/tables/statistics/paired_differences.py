"""Mean, interval and p-value of differences that are paired by seed and clip."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from memmlp.tables.statistics.crossed_seeds_and_groups import Groups, error

LEVEL = 0.05


class EffectEstimates(NamedTuple):
    """The effects of K comparisons.

    Attributes:
        mean: the mean difference (K,).
        low, high: the ends of its 95 % interval (K,); NaN if there is none.
        p: its p-value (K,); NaN if there is none.
        conditional: what there is only one of, so that interval and mean don't cover others: "seeds", "clips"
            (one group of them), "seeds and clips", or "" if there are several of both. Unless it is "", there
            are no p-values.
    """

    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray
    p: np.ndarray
    conditional: str


def paired_effects(differences: np.ndarray, groups: Groups = None) -> EffectEstimates:
    """Return the effects of differences (K, S, C) over seeds and clips, whose groups are `groups` (C,).

    Interval and p-value agree: 0 is outside the interval exactly if p is below 0.05.
    """
    mean, known = differences.mean((1, 2)), error(differences, groups)
    nothing = np.full_like(mean, np.nan)
    half = nothing if known.conditional == "seeds and clips" else known.half(LEVEL)
    p = nothing if known.conditional else known.level(np.abs(mean))
    return EffectEstimates(mean, mean - half, mean + half, p, known.conditional)


def seed_effects(differences: np.ndarray) -> EffectEstimates:
    """Return the effects of differences (K, S) in something that each seed has once, such as a time."""
    alone = differences[:, :, None]
    effects, several = paired_effects(alone), differences.shape[1] > 1
    p = error(alone).level(np.abs(effects.mean)) if several else effects.p
    return effects._replace(p=p, conditional="" if several else "seeds")


def equivalence_p(differences: np.ndarray, margin: float | np.ndarray, groups: Groups = None) -> np.ndarray:
    """Return the p-values (K,) of the claim that means of differences (K, S, C) lie within +-margin.

    The margin is () or (K,), in the unit of the differences. A p-value is the level at which the interval
    just lies within the margin. Two one-sided tests would use the interval of twice that level (Schuirmann
    1987). So this test is on the safe side, and it agrees with the interval that is shown. The p-values are
    NaN with one seed or one group.
    """
    known = error(differences, groups)
    if known.conditional:
        return np.full(len(differences), np.nan)
    return known.level(margin - np.abs(differences.mean((1, 2))))
