"""How often verdicts are wrong, counted in simulated tables: a check of the promises of the statistics.

The arrays' axes are: K comparisons (T tables of TABLE each), S seeds, C clips, G groups of clips.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from memmlp.tables.statistics.paired_differences import LEVEL
from memmlp.tables.statistics.simulation import SHARES, Shares, Simulated, SimulationSetting, choices
from memmlp.tables.statistics.verdicts import holm, sequential, spending

SEEDS, CLIPS, SIZES = (2, 3, 5, 10), (4, 10, 40, 536), (1, 2, 10)
ARMS, METRICS = 6, 4
TABLE = ARMS * METRICS  # comparisons of a table
CHUNK = 4_000_000  # numbers that are drawn at once, which bounds the memory

ERROR, LEAST, MOST = 0.06, 0.93, 0.995
"""The promises that are tested.

A family-wise error of at most ERROR and a coverage of at least LEAST everywhere; from 3 seeds and 5 groups on
also a coverage of at most MOST, so that intervals are not too wide.
"""

MARGIN, EFFECT = 8.0, 16.0
"""The smallest effect of interest, and the effect that half of the arms have in simulated campaigns.

Both are in standard errors.
"""
CAMPAIGNS = 200  # tables with effects for each cell of the grid


def grid() -> list[SimulationSetting]:
    """Return all cells of the grid that have at least two groups."""
    cells = itertools.starmap(SimulationSetting, itertools.product(SEEDS, CLIPS, SIZES))
    return [cell for cell in cells if cell.groups[-1] > 0]


class SimulatedOutcomes(NamedTuple):
    """Outcomes in simulated tables whose true differences are all zero.

    Attributes:
        covered: whether the 95 % interval covers the truth (K,).
        starred: whether a table has any star (T,), which is then a false one, with all seeds at once.
        in_looks: the same if seeds are added in looks (T,).
        found: the smallest true effect that would have been found (K,): half the interval's width at Holm's
            first step, minus the simulated mean.
    """

    covered: np.ndarray
    starred: np.ndarray
    in_looks: np.ndarray
    found: np.ndarray


def count(sample: Simulated, shares: Shares) -> SimulatedOutcomes:
    """Count the outcomes in one sample with effects in these shares.

    All nulls are true, so Holm gives a table a star exactly if its first step does.
    """
    in_looks = np.zeros(len(sample.seeds), bool)
    for seeds, level in spent(sample):
        known, mean = sample.mixed(shares, seeds)
        in_looks |= np.abs(mean) > known.half(level / TABLE)
    half = known.half(LEVEL / TABLE)
    covered = np.abs(mean) <= known.half(LEVEL)
    return SimulatedOutcomes(covered, _any(np.abs(mean) > half), _any(in_looks), half - mean)


def spent(sample: Simulated) -> Iterator[tuple[int, float]]:
    """Return the number of seeds of each look, with the level that it may spend."""
    return zip(sample.looks, spending(len(sample.looks)), strict=True)


def _any(claims: np.ndarray) -> np.ndarray:
    """Return for each table (T,) whether any of its claims is made, given claims (K,)."""
    return np.any(claims.reshape(-1, TABLE), axis=1)


def summary(counts: Sequence[SimulatedOutcomes]) -> dict[str, float]:
    """Return the rates over all samples, and the power.

    Power is the share of comparisons that find the effect which an oracle, who knows the variances, finds in
    80 % of tables. `effect_ratio` is the effect found in 80 % of tables, divided by the oracle's.
    """
    from scipy.special import ndtri

    covered, starred, in_looks, found = map(np.concatenate, zip(*counts, strict=True))
    oracle = ndtri(1 - LEVEL / TABLE / 2) + ndtri(0.8)
    return {
        "coverage": float(covered.mean()),
        "error": float(starred.mean()),
        "sequential_error": float(in_looks.mean()),
        "power": float((found < oracle).mean()),
        "effect_ratio": float(np.quantile(found, 0.8) / oracle),
    }


class Campaign(NamedTuple):
    """Outcomes in simulated tables that spend seeds until everything is decided.

    Attributes:
        seeds: the number of seeds that each arm spent (T, ARMS).
        decided: whether each comparison was decided in looks (T, TABLE).
        at_once: whether each is decided with all seeds at once (T, TABLE).
        false: whether a table made any false claim in looks (T,).
    """

    seeds: np.ndarray
    decided: np.ndarray
    at_once: np.ndarray
    false: np.ndarray


def campaign(sample: Simulated, shares: Shares) -> Campaign:
    """Simulate tables that are looked at with more and more seeds; half of the arms differ by EFFECT.

    An arm stops when all of its comparisons are decided.
    """
    tables = len(sample.seeds) // TABLE
    truth = np.repeat(np.arange(ARMS) % 2 * EFFECT, METRICS)
    differ, same = np.zeros((2, tables, TABLE), bool)
    seeds = np.zeros((tables, ARMS), int)
    for number, level in spent(sample):
        seeds[~(differ | same).reshape(tables, ARMS, METRICS).all(2)] = number
        known, mean = sample.mixed(shares, number)
        means = mean.reshape(tables, TABLE) + truth
        p, q = (known.level(d.ravel()).reshape(means.shape) for d in (np.abs(means), MARGIN - np.abs(means)))
        now_same = _claimed(q, same, differ, level)
        differ = _claimed(p, differ, now_same, level)
        same = now_same
    at_once = np.array([(holm(x) <= LEVEL) | (holm(y) <= LEVEL) for x, y in zip(p, q, strict=True)])
    false = (differ & (truth == 0) | same & (truth > 0)).any(1)
    return Campaign(seeds, differ | same, at_once, false)


def _claimed(p: np.ndarray, before: np.ndarray, closed: np.ndarray, level: float) -> np.ndarray:
    """Return what a family of claims has claimed after a look (T, TABLE).

    Args:
        p: p-values at the look (T, TABLE).
        before: what the family claimed at earlier looks (T, TABLE).
        closed: what the other family has claimed (T, TABLE).
        level: what the look may spend.
    """
    rows = zip(p, before, closed & ~before, strict=True)
    return np.array([sequential(*row) <= level for row in rows])


def simulate(cell: SimulationSetting, tables: int, seed: int) -> dict[str, Any]:
    """Simulate a cell of the grid, and return everything that is reported about it."""
    rng = np.random.default_rng([seed, *cell])
    size = max(1, CHUNK // (TABLE * cell.seeds * cell.clips))
    every = choices(cell)
    counts: dict[str, list[SimulatedOutcomes]] = {name: [] for name in every}
    campaigns: list[Campaign] = []
    for start in range(0, tables, size):
        sample = Simulated(rng, cell, TABLE * min(size, tables - start))
        for name, shares in every.items():
            counts[name].append(count(sample, shares))
        if start < CAMPAIGNS:
            campaigns.append(campaign(sample, SHARES["equal"]))
    return {
        **cell._asdict(),
        "groups": int(cell.groups[-1]) + 1,
        "tables": tables,
        "shares": {name: summary(parts) for name, parts in counts.items()},
        "campaign": told(campaigns),
    }


def told(campaigns: Sequence[Campaign]) -> dict[str, float]:
    """Return means over simulated tables that spend seeds until everything is decided."""
    names = ("seeds", "decided", "decided_at_once", "error")
    return {
        name: float(np.concatenate(part).mean())
        for name, part in zip(names, zip(*campaigns, strict=True), strict=True)
    }


def extreme(row: dict[str, Any], what: str, pick: Any) -> tuple[float, str]:
    """Return a row's least or largest rate (`pick` is min or max), with the name of its shares."""
    return pick((rates[what], name) for name, rates in row["shares"].items())


def broken(row: dict[str, Any], capped: bool) -> list[str]:
    """List the promises that a cell breaks by more than two standard errors of the simulation."""
    tables = row["tables"]
    limits = [
        ("coverage", min, LEAST, -1, TABLE),
        ("error", max, ERROR, 1, 1),
        ("sequential_error", max, ERROR, 1, 1),
    ]
    limits += [("coverage", max, MOST, 1, TABLE)] if capped else []
    return [
        f"{what} {100 * value:.2f} % ({name})"
        for what, pick, limit, sign, each in limits
        for value, name in [extreme(row, what, pick)]
        if sign * (value - limit) > 2 * np.sqrt(limit * (1 - limit) / tables / each)
    ]
