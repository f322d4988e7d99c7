"""`memmlp bench calibration`: do the verdicts' intervals and p-values keep their promises? In simulations."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np

from memmlp.statistics import holm, looks, sequential, spending
from memmlp.statistics.crossed import Error, by_group, combined
from memmlp.statistics.crossed import noise as residual

SEEDS, CLIPS, SIZES = (2, 3, 5, 10), (4, 10, 40, 536), (1, 2, 10)
ARMS, METRICS = 6, 4
TABLE = ARMS * METRICS  # comparisons
LEVEL = 0.05
CHUNK = 3_000_000  # numbers simulated at once

PROMISES = {"error": 0.06, "least": 0.93, "most": 0.995}
"""Family-wise error at most, coverage at least, and at most from 3 seeds and 5 groups on."""

MARGIN, EFFECT = 8.0, 16.0
"""Of the tables with effects, in standard errors of a mean over all seeds: the smallest of interest, and theirs."""


class Shares(NamedTuple):
    """Of the variance of a mean over seeds and clips, what each brings."""

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
    "seeds, groups": Shares(seeds=1, groups=1),
    "seeds, clips": Shares(seeds=1, clips=1),
    "seeds, noise": Shares(seeds=1, noise=1),
    "groups, clips": Shares(groups=1, clips=1),
    "groups, noise": Shares(groups=1, noise=1),
    "clips, noise": Shares(clips=1, noise=1),
    "equal": Shares(seeds=1, groups=1, clips=1, noise=1),
    "skewed": Shares(skewed=1),
    "seeds, skewed": Shares(seeds=1, skewed=1),
    "groups, skewed": Shares(groups=1, skewed=1),
    "skewed, noise": Shares(skewed=1, noise=1),
    "equal, skewed": Shares(seeds=1, groups=1, skewed=1, noise=1),
}


class Cell(NamedTuple):
    """A row of the grid."""

    seeds: int
    clips: int
    size: int

    @property
    def groups(self) -> np.ndarray:
        """The group of each clip (C,)."""
        return np.arange(self.clips) // self.size


def grid() -> list[Cell]:
    """All cells that have two groups at least."""
    cells = itertools.starmap(Cell, itertools.product(SEEDS, CLIPS, SIZES))
    return [cell for cell in cells if cell.groups[-1] > 0]


@dataclass
class Tally:
    """What was counted of one cell's tables with one choice of shares."""

    covered: list[np.ndarray] = field(default_factory=list)
    starred: list[np.ndarray] = field(default_factory=list)
    sequential: list[np.ndarray] = field(default_factory=list)
    needed: list[np.ndarray] = field(default_factory=list)

    def summary(self) -> dict[str, float]:
        """Coverage, error rates, power where an oracle's is 80 %, and the effect for 80 % beside the oracle's."""
        needed = np.concatenate(self.needed)
        oracle = _oracle()
        return {
            "coverage": float(np.concatenate(self.covered).mean()),
            "error": float(np.concatenate(self.starred).mean()),
            "sequential_error": float(np.concatenate(self.sequential).mean()),
            "power": float((needed < oracle).mean()),
            "effect_ratio": float(np.quantile(needed, 0.8) / oracle),
        }


def _oracle() -> float:
    """The effect, in standard errors, that is found in 80 % of tables by who knows the variances."""
    from scipy.special import ndtri

    return float(ndtri(1 - LEVEL / TABLE / 2) + ndtri(0.8))


def simulate(cell: Cell, tables: int, seed: int) -> dict[str, dict[str, float]]:
    """Summaries of tables of true nulls, by choice of shares."""
    tallies = {name: Tally() for name in SHARES}
    rng = np.random.default_rng([seed, *cell])
    size = max(1, CHUNK // (TABLE * cell.seeds * cell.clips))
    for start in range(0, tables, size):
        units = draw(rng, cell, TABLE * min(size, tables - start))
        for name, shares in SHARES.items():
            count(tallies[name], units, shares)
    return {name: tally.summary() for name, tally in tallies.items()}


class Units:
    """Effects of each kind, each of which gives the mean over seeds and clips a variance of 1."""

    def __init__(self, seeds: np.ndarray, fixed: list[np.ndarray], noise: np.ndarray, weights: np.ndarray):
        """Of seeds (K, S), of groups (K, G) by three causes, noise (K, S, G), and the groups' weights (G,)."""
        self.seeds, self.fixed, self.weights = seeds, fixed, weights
        self.looks = {n: (noise[:, :n] @ weights, noise[:, :n].mean(1), residual(noise[:, :n], weights)) for n in {*looks(noise.shape[1])}}

    def mixed(self, shares: Shares, seeds: int) -> tuple[Error, np.ndarray]:
        """Error and mean (K,) of the first so many seeds with these shares of variance."""
        first, *middle, last = np.sqrt(np.array(shares) / sum(shares))
        by_seed, by_group, rest = self.looks[seeds]
        effects = sum((w * u for w, u in zip(middle, self.fixed, strict=True) if w), 0 * self.fixed[0])
        of_seeds = first * self.seeds[:, :seeds]
        a = of_seeds + (effects @ self.weights)[:, None] + last * by_seed
        b = of_seeds.mean(1)[:, None] + effects + (last * by_group if last else 0)
        return combined(a, b, last**2 * rest, self.weights), a.mean(1)


def draw(rng: np.random.Generator, cell: Cell, comparisons: int) -> Units:
    """Units of so many comparisons."""
    seeds, clips, _ = cell
    _, weights = by_group(np.zeros((1, 1, clips)), cell.groups)

    def grouped(effects: np.ndarray) -> np.ndarray:
        return by_group(effects, cell.groups)[0]

    by_clip = (comparisons, 1, clips)
    fixed = [
        rng.normal(size=(comparisons, len(weights))) / np.sqrt(weights @ weights),
        np.sqrt(clips) * grouped(rng.normal(size=by_clip))[:, 0],
        np.sqrt(clips) * grouped(rng.exponential(size=by_clip) - 1)[:, 0],
    ]
    noise = np.sqrt(seeds * clips) * grouped(rng.normal(size=(comparisons, seeds, clips)))
    return Units(np.sqrt(seeds) * rng.normal(size=(comparisons, seeds)), fixed, noise, weights)


def count(tally: Tally, units: Units, shares: Shares) -> None:
    """Add tables of true nulls to a tally.

    Of true nulls alone, Holm calls something significant where its first step does.
    """
    rounds = looks(units.seeds.shape[1])
    false = False
    for seeds, level in zip(rounds, spending(len(rounds)), strict=True):
        known, mean = units.mixed(shares, seeds)
        false |= np.abs(mean) > known.half(level / TABLE)
    half = known.half(LEVEL / TABLE)
    tally.covered.append(np.abs(mean) <= known.half(LEVEL))
    tally.starred.append(_any(np.abs(mean) > half))
    tally.needed.append(half - mean)
    tally.sequential.append(_any(false))


def _any(false: np.ndarray) -> np.ndarray:
    """Whether a table has any, (tables,)."""
    return false.reshape(-1, TABLE).any(1)
