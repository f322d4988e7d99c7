"""Descriptions that a few clips can't carry away, after rliable (Agarwal et al. 2021, "Deep reinforcement
learning at the edge of the statistical precipice"), for errors (S, C) of seeds on clips: lower is better."""

from __future__ import annotations

import numpy as np


def probability_of_improvement(ours: np.ndarray, theirs: np.ndarray) -> float:
    """How often a run of ours (S, C) has a smaller error than one of theirs (T, C) on the same clip.

    Over all pairs of seeds, then the mean over clips; a tie counts half.
    """
    difference = theirs[None] - ours[:, None]
    return float(((np.sign(difference) + 1) / 2).mean())


def interquartile_mean(errors: np.ndarray) -> float:
    """The mean of the middle half of all errors (S, C)."""
    from scipy.stats import trim_mean  # slow to import

    return float(trim_mean(errors, 0.25, axis=None))


def performance_profile(errors: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
    """The fraction of errors (S, C) that are at most each of the thresholds (N,)."""
    return (errors.reshape(-1, 1) <= thresholds).mean(0)
