"""Descriptions of errors that a few extreme clips can't dominate, as in the library rliable.

Source: Agarwal et al. 2021, "Deep reinforcement learning at the edge of the statistical precipice". Errors
are (S, C), of S seeds on C clips; lower is better.
"""

from __future__ import annotations

import numpy as np


def probability_of_improvement(ours: np.ndarray, theirs: np.ndarray) -> float:
    """Return how often one of our runs (S, C) has a smaller error than one of theirs (T, C) on a clip.

    All pairs of seeds are compared on each clip; a tie counts half.
    """
    difference = theirs[None] - ours[:, None]
    return float(((np.sign(difference) + 1) / 2).mean())


def interquartile_mean(errors: np.ndarray) -> float:
    """Return the mean of the middle half of all errors (S, C)."""
    from scipy.stats import trim_mean  # slow to import

    return float(trim_mean(errors, 0.25, axis=None))


def performance_profile(errors: np.ndarray, thresholds: np.ndarray) -> np.ndarray:
    """Return, for each threshold (N,), the fraction of errors (S, C) that are at most as large."""
    return (errors.reshape(-1, 1) <= thresholds).mean(0)
