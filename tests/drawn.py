"""Random differences with means of known variance."""

import numpy as np

from memmlp.report.tables.statistics import correct_by_holm

TABLE = 24  # comparisons of a table
SHARES = {  # of seeds, clips' groups, clips, exponential clips and noise in the mean's variance
    "equal": (1, 0, 1, 0, 1),
    "values": (40 / 3, 0, 1, 0, 1 / 3),  # equal variances in a single value, for 3 seeds and 40 clips
    "seeds": (1, 0, 0, 0, 0),
    "groups": (0, 1, 0, 0, 0),
    "noise": (0, 0, 0, 0, 1),
    "skewed": (0, 0, 0, 1, 0),
    "skewed, little noise": (0, 0, 0, 20, 1),
    "seeds, skewed": (1, 0, 0, 1, 0),
}


def differences(seeds: int, clips: int, size: int, shares: tuple[float, ...], tables: int) -> np.ndarray:
    """Draw differences (tables * TABLE, S, C) with true means of 0; their means have a variance of 1."""
    rng = np.random.default_rng([seeds, clips, size])
    group = np.arange(clips) // size
    weights = np.bincount(group) / clips
    a, g, b, x, e = np.sqrt(np.array(shares) / sum(shares))
    k = tables * TABLE
    by_clip = b * rng.normal(size=(k, 1, clips)) + x * (rng.exponential(size=(k, 1, clips)) - 1)
    by_group = rng.normal(size=(k, 1, len(weights)))[:, :, group] / np.sqrt(weights @ weights)
    by_seed = np.sqrt(seeds) * rng.normal(size=(k, seeds, 1))
    noise = np.sqrt(seeds * clips) * rng.normal(size=(k, seeds, clips))
    return a * by_seed + g * by_group + np.sqrt(clips) * by_clip + e * noise


def groups(clips: int, size: int) -> np.ndarray:
    return np.arange(clips) // size


def starred(p: np.ndarray) -> float:
    """Return the share of tables with a star; all true differences are 0."""
    return float(np.mean([(correct_by_holm(row) <= 0.05).any() for row in p.reshape(-1, TABLE)]))
