"""Simulated differences of arms that do not truly differ; the variances of seeds and clips are given.

The arrays' axes are: K comparisons, S seeds, C clips, G groups of clips.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from memmlp.tables.statistics.crossed_seeds_and_groups import Error, by_group
from memmlp.tables.statistics.verdicts import looks


class Shares(NamedTuple):
    """The share of each source in the variance of a mean over seeds and clips; only their ratios matter."""

    seeds: float = 0
    groups: float = 0
    clips: float = 0
    skewed: float = 0  # clips whose effects are exponential
    noise: float = 0


SHARES = {
    "seeds": Shares(seeds=1),
    "groups": Shares(groups=1),
    "clips": Shares(clips=1),
    "noise": Shares(noise=1),
    "seeds+groups": Shares(seeds=1, groups=1),
    "seeds+clips": Shares(seeds=1, clips=1),
    "seeds+noise": Shares(seeds=1, noise=1),
    "groups+clips": Shares(groups=1, clips=1),
    "groups+noise": Shares(groups=1, noise=1),
    "clips+noise": Shares(clips=1, noise=1),
    "equal": Shares(seeds=1, groups=1, clips=1, noise=1),
    "skewed": Shares(skewed=1),
    "seeds+skewed": Shares(seeds=1, skewed=1),
    "groups+skewed": Shares(groups=1, skewed=1),
    "skewed+noise": Shares(skewed=1, noise=1),
    "skewed+noise/20": Shares(skewed=20, noise=1),
    "seeds/20+noise": Shares(seeds=1, noise=20),
    "equal, skewed": Shares(seeds=1, groups=1, skewed=1, noise=1),
}


def choices(cell: SimulationSetting) -> dict[str, Shares]:
    """Return the shares that are simulated in a cell of the grid, by name.

    SHARES divide the variance of the mean. "values" instead gives every source the same variance in a single
    value d[s, c], so that in the variance of the mean seeds have 1 / S, groups 1 over their number, and so
    on.
    """
    seeds, clips, size = cell
    values = Shares(seeds=1 / seeds, groups=size / clips, clips=1 / clips, noise=1 / seeds / clips)
    return SHARES | {"values": values}


class SimulationSetting(NamedTuple):
    """A cell of the simulated grid: a number of seeds, of clips, and of clips in each group."""

    seeds: int
    clips: int
    size: int  # clips of a group

    @property
    def groups(self) -> np.ndarray:
        """The group of each clip (C,)."""
        return np.arange(self.clips) // self.size

    @property
    def capped(self) -> bool:
        """Whether intervals of this cell are promised not to be too wide: not with few seeds or groups."""
        return self.seeds >= 3 and self.groups[-1] >= 4


class SimulatedLook(NamedTuple):
    """What is needed for a look at the first seeds of K comparisons, for effects in any shares.

    Every kind of effect is scaled so that, with all seeds, it gives the mean a variance of 1.

    Attributes:
        noise: the means (K, S) of the noise over clips, by seed.
        variance: the variance E (K,) of the noise alone (`crossed_seeds_and_groups`).
        covariances: covariances (K, 4, 4) between the groups' means of the effects of groups, clips, skewed
            clips and noise.
    """

    noise: np.ndarray
    variance: np.ndarray
    covariances: np.ndarray


class Simulated:
    """Simulated differences of K comparisons without a true effect.

    Drawing is slow and there are many choices of shares. So each kind of effect is drawn once, and enough of
    it is kept to mix the kinds in any shares later.
    """

    def __init__(self, rng: np.random.Generator, cell: SimulationSetting, comparisons: int):
        """Draw the effects of all seeds, groups and clips, and the noise of all single values."""
        self.seeds = np.sqrt(cell.seeds) * rng.normal(size=(comparisons, cell.seeds))
        fixed, noise, self.weights = draw(rng, cell, comparisons)
        self.means = fixed @ self.weights  # (K, 3)
        variances = noise.var(2, ddof=1)
        self.looks = {n: self._look(fixed, noise[:, :n], variances[:, :n]) for n in looks(cell.seeds)}

    def _look(self, fixed: np.ndarray, noise: np.ndarray, variances: np.ndarray) -> SimulatedLook:
        """Return what is needed for a look at its seeds.

        Args:
            fixed: the groups' means of the effects of groups, clips and skewed clips (K, 3, G).
            noise: the groups' means of the noise (K, S, G), for the look's seeds.
            variances: the variance of each seed's noise over groups (K, S).
        """
        effects = np.concatenate([fixed, noise.mean(1, keepdims=True)], 1)
        effects -= effects.mean(2, keepdims=True)
        covariances = effects @ effects.transpose(0, 2, 1) / (len(self.weights) - 1)
        rest = variances.mean(1) - covariances[:, 3, 3]  # that of all cells less that of their groups
        e = rest * (self.weights @ self.weights) / (noise.shape[1] - 1)
        return SimulatedLook(noise @ self.weights, e, covariances)

    def mixed(self, shares: Shares, seeds: int) -> tuple[Error, np.ndarray]:
        """Mix the kinds of effects, and return the estimated error of the mean and the mean (K,).

        Args:
            shares: the shares of the kinds in the mean's variance, which is 1 with all seeds.
            seeds: how many seeds are looked at, from the first one on.
        """
        weights = np.sqrt(np.array(shares) / sum(shares))
        look = self.looks[seeds]
        by_seed = weights[0] * self.seeds[:, :seeds] + weights[4] * look.noise
        a = by_seed.var(1, ddof=1) / seeds
        b = (look.covariances @ weights[1:]) @ weights[1:] * (self.weights @ self.weights)
        known = Error(np.stack([a, b, weights[4] ** 2 * look.variance]), seeds - 1, len(self.weights) - 1)
        return known, by_seed.mean(1) + self.means @ weights[1:4]


def draw(rng: np.random.Generator, cell: SimulationSetting, comparisons: int) -> tuple[np.ndarray, ...]:
    """Draw all effects except those of seeds, scaled so that each kind gives the mean a variance of 1.

    Returns:
        The groups' means of the effects of groups, clips and skewed clips (K, 3, G); the groups' means of the
        noise (K, S, G); the groups' weights (G,).
    """
    seeds, clips, _ = cell
    by_clip = np.sqrt(clips) * np.stack(
        [rng.normal(size=(comparisons, clips)), rng.exponential(size=(comparisons, clips)) - 1], 1
    )
    by_clip, weights = by_group(by_clip, cell.groups)
    of_groups = rng.normal(size=(comparisons, 1, len(weights))) / np.sqrt(weights @ weights)
    noise = np.sqrt(seeds * clips) * rng.normal(size=(comparisons, seeds, clips))
    if cell.size > 1:
        noise, _ = by_group(noise, cell.groups)
    return np.concatenate([of_groups, by_clip], 1), noise, weights
