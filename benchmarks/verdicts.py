"""Simulate tables with a known truth, and count how often verdicts are wrong.

Run `python benchmarks/verdicts.py --tables 5000 --seed 20253`; docs/results/verdicts.md has the output.
Axes of arrays: K comparisons (T tables of TABLE each), S seeds, C clips, G clip groups.
"""

import itertools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import click
import numpy as np
from scipy.special import ndtri

from memmlp.common.progress import progress_bar
from memmlp.report.tables.statistics import (
    LEVEL,
    Error,
    average_groups,
    correct_by_holm,
    correct_sequentially,
    divide_level,
    make_schedule,
)


class Shares(NamedTuple):
    """The share of each source in the variance of a mean over seeds and clips; only their ratios matter."""

    seeds: float = 0
    groups: float = 0
    clips: float = 0
    skewed: float = 0  # clips whose effects are exponential
    noise: float = 0


SHARES = {
    "seeds": Shares(seeds=1), "groups": Shares(groups=1), "clips": Shares(clips=1), "noise": Shares(noise=1),
    "seeds+groups": Shares(seeds=1, groups=1), "seeds+clips": Shares(seeds=1, clips=1),
    "seeds+noise": Shares(seeds=1, noise=1), "groups+clips": Shares(groups=1, clips=1),
    "groups+noise": Shares(groups=1, noise=1), "clips+noise": Shares(clips=1, noise=1),
    "equal": Shares(seeds=1, groups=1, clips=1, noise=1), "skewed": Shares(skewed=1),
    "seeds+skewed": Shares(seeds=1, skewed=1), "groups+skewed": Shares(groups=1, skewed=1),
    "skewed+noise": Shares(skewed=1, noise=1), "skewed+noise/20": Shares(skewed=20, noise=1),
    "seeds/20+noise": Shares(seeds=1, noise=20),
    "equal, skewed": Shares(seeds=1, groups=1, skewed=1, noise=1),
}  # fmt: skip


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


def choices(cell: SimulationSetting) -> dict[str, Shares]:
    """Return the shares that are simulated in a cell of the grid, by name.

    SHARES divide the variance of the mean. "values" instead gives every source the same variance in a single
    value d[s, c].
    """
    seeds, clips, size = cell
    values = Shares(seeds=1 / seeds, groups=size / clips, clips=1 / clips, noise=1 / seeds / clips)
    return SHARES | {"values": values}


class InterimSample(NamedTuple):
    """The sufficient statistics of an interim analysis of K comparisons, for effects in any shares.

    Every kind of effect is scaled so that it gives the mean over all seeds a variance of 1. The covariances
    are those of the groups' means of four effects: groups, clips, skewed clips and noise.
    """

    noise: np.ndarray  # the means of the noise over clips, by seed (K, S)
    variance: np.ndarray  # the variance E of the noise alone (K,)
    covariances: np.ndarray  # (K, 4, 4)


class Simulated:
    """Simulated differences of K comparisons without a true effect.

    Drawing is slow, so each kind of effect is drawn once; `mixed` then mixes the kinds in any shares.
    """

    def __init__(self, rng: np.random.Generator, cell: SimulationSetting, comparisons: int):
        self.seeds = np.sqrt(cell.seeds) * rng.normal(size=(comparisons, cell.seeds))
        fixed, noise, self.weights = draw(rng, cell, comparisons)
        self.means = fixed @ self.weights  # (K, 3)
        variances = noise.var(2, ddof=1)
        self.interim = {
            n: self._sample(fixed, noise[:, :n], variances[:, :n]) for n in make_schedule(cell.seeds)
        }

    def _sample(self, fixed: np.ndarray, noise: np.ndarray, variances: np.ndarray) -> InterimSample:
        """Summarise fixed effects (K, 3, G), noise (K, S, G) and its variance over groups (K, S)."""
        effects = np.concatenate([fixed, noise.mean(1, keepdims=True)], 1)
        effects -= effects.mean(2, keepdims=True)
        covariances = effects @ effects.transpose(0, 2, 1) / (len(self.weights) - 1)
        rest = variances.mean(1) - covariances[:, 3, 3]  # of all cells, less that of their groups
        e = rest * (self.weights @ self.weights) / (noise.shape[1] - 1)
        return InterimSample(noise @ self.weights, e, covariances)

    def mixed(self, shares: Shares, seeds: int) -> tuple[Error, np.ndarray]:
        """Mix the kinds of effects, and return the estimated error of the mean and the mean (K,).

        Args:
            shares: the shares of the kinds in the mean's variance, which is 1 with all seeds.
            seeds: how many seeds are analysed, from the first one on.
        """
        weights = np.sqrt(np.array(shares) / sum(shares))
        sample = self.interim[seeds]
        by_seed = weights[0] * self.seeds[:, :seeds] + weights[4] * sample.noise
        a = by_seed.var(1, ddof=1) / seeds
        b = (sample.covariances @ weights[1:]) @ weights[1:] * (self.weights @ self.weights)
        known = Error(np.stack([a, b, weights[4] ** 2 * sample.variance]), seeds - 1, len(self.weights) - 1)
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
    by_clip, weights = average_groups(by_clip, cell.groups)
    of_groups = rng.normal(size=(comparisons, 1, len(weights))) / np.sqrt(weights @ weights)
    noise = np.sqrt(seeds * clips) * rng.normal(size=(comparisons, seeds, clips))
    if cell.size > 1:
        noise, _ = average_groups(noise, cell.groups)
    return np.concatenate([of_groups, by_clip], 1), noise, weights


SEEDS, CLIPS, SIZES = (2, 3, 5, 10), (4, 10, 40, 536), (1, 2, 10)
VARIANTS, METRICS = 6, 4
TABLE = VARIANTS * METRICS  # comparisons of a table
CHUNK = 4_000_000  # numbers that are drawn at once, which bounds the memory

ERROR, LEAST, MOST = 0.06, 0.93, 0.995
"""The largest family-wise error, and the least coverage; from 3 seeds and 5 groups on, the most coverage."""

MARGIN, EFFECT = 8.0, 16.0
"""The smallest effect of interest, and the effect of half the variants in campaigns, in standard errors."""
CAMPAIGNS = 200  # tables with effects for each cell of the grid


def grid() -> list[SimulationSetting]:
    """Return the cells that have at least two groups."""
    cells = itertools.starmap(SimulationSetting, itertools.product(SEEDS, CLIPS, SIZES))
    return [cell for cell in cells if cell.groups[-1] > 0]


def count(sample: Simulated, shares: Shares) -> dict[str, np.ndarray]:
    """Count the outcomes in one sample with effects in these shares, whose true differences are zero.

    All nulls are true, so Holm gives a table a star exactly if its first step does.

    Returns:
        covered: whether the 95 % interval covers the truth (K,).
        starred, sequential: whether a table has a (false) star, with all seeds at once or with interim
            analyses (T,).
        found: the smallest true effect that would have been found at Holm's first step (K,).
    """
    sequential = np.zeros(len(sample.seeds), bool)
    for seeds, level in levels(sample):
        known, mean = sample.mixed(shares, seeds)
        sequential |= np.abs(mean) > known.compute_half_width(level / TABLE)
    half = known.compute_half_width(LEVEL / TABLE)
    return {
        "covered": np.abs(mean) <= known.compute_half_width(LEVEL),
        "starred": _any(np.abs(mean) > half), "sequential": _any(sequential), "found": half - mean,
    }  # fmt: skip


def levels(sample: Simulated) -> Iterator[tuple[int, float]]:
    """Return the number of seeds of each interim analysis, and the level that it may spend."""
    return zip(sample.interim, divide_level(len(sample.interim)), strict=True)


def _any(claims: np.ndarray) -> np.ndarray:
    """Return for each table (T,) whether any of its claims is made, given claims (K,)."""
    return np.any(claims.reshape(-1, TABLE), axis=1)


def join(counts: Sequence[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    return {name: np.concatenate([part[name] for part in counts]) for name in counts[0]}


def summary(counts: Sequence[dict[str, np.ndarray]]) -> dict[str, float]:
    """Return the rates over all samples, and the power.

    Power is the share of comparisons that find the effect which an oracle, who knows the variances, finds in
    80 % of tables. `effect_ratio` is the effect found in 80 % of tables, divided by the oracle's.
    """
    of, oracle = join(counts), ndtri(1 - LEVEL / TABLE / 2) + ndtri(0.8)
    return {
        "coverage": float(of["covered"].mean()),
        "error": float(of["starred"].mean()),
        "sequential_error": float(of["sequential"].mean()),
        "power": float((of["found"] < oracle).mean()),
        "effect_ratio": float(np.quantile(of["found"], 0.8) / oracle),
    }


def campaign(sample: Simulated, shares: Shares) -> dict[str, np.ndarray]:
    """Simulate tables with interim analyses; half of the variants differ by EFFECT.

    A variant stops when all of its comparisons are decided.

    Returns:
        seeds: the number of seeds that each variant spent (T, VARIANTS).
        decided, decided_at_once: whether each comparison was decided in an interim analysis, and with all
            seeds at once (T, TABLE).
        error: whether a table made any false claim in an interim analysis (T,).
    """
    tables = len(sample.seeds) // TABLE
    truth = np.repeat(np.arange(VARIANTS) % 2 * EFFECT, METRICS)
    differ, same = np.zeros((2, tables, TABLE), bool)
    seeds = np.zeros((tables, VARIANTS), int)
    for number, level in levels(sample):
        seeds[~(differ | same).reshape(tables, VARIANTS, METRICS).all(2)] = number
        known, mean = sample.mixed(shares, number)
        means = mean.reshape(tables, TABLE) + truth
        p, q = (
            known.compute_significance_level(d.ravel()).reshape(means.shape)
            for d in (np.abs(means), MARGIN - np.abs(means))
        )
        now_same = _claimed(q, same, differ, level)
        differ = _claimed(p, differ, now_same, level)
        same = now_same
    at_once = [np.minimum(correct_by_holm(x), correct_by_holm(y)) <= LEVEL for x, y in zip(p, q, strict=True)]
    false = (differ & (truth == 0) | same & (truth > 0)).any(1)
    return {"seeds": seeds, "decided": differ | same, "decided_at_once": np.array(at_once), "error": false}


def _claimed(p: np.ndarray, before: np.ndarray, closed: np.ndarray, level: float) -> np.ndarray:
    """Return all claims of a family after an interim analysis (T, TABLE).

    Args:
        p: p-values of this analysis (T, TABLE).
        before: the family's claims of earlier analyses (T, TABLE).
        closed: the other family's claims (T, TABLE).
        level: the level that this analysis may spend.
    """
    rows = zip(p, before, closed & ~before, strict=True)
    return np.array([correct_sequentially(*row) <= level for row in rows])


def simulate(cell: SimulationSetting, tables: int, seed: int) -> dict[str, Any]:
    """Simulate a cell of the grid, and return its report."""
    rng = np.random.default_rng([seed, *cell])
    size = max(1, CHUNK // (TABLE * cell.seeds * cell.clips))
    every = choices(cell)
    counts: dict[str, list[dict[str, np.ndarray]]] = {name: [] for name in every}
    campaigns: list[dict[str, np.ndarray]] = []
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
        "campaign": {name: float(values.mean()) for name, values in join(campaigns).items()},
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


HEADER = ["design", "coverage", "star", "of", "interim", "power", "effect", "seeds", "decided"]


def columns(row: dict[str, Any]) -> list[str]:
    least, most = (100 * extreme(row, "coverage", pick)[0] for pick in (min, max))
    error, worst = extreme(row, "error", max)
    equal, spent = row["shares"]["equal"], row["campaign"]
    return [
        f"{row['seeds']} x {row['clips']} / {row['size']}",
        f"{least:.1f}-{most:.1f}",
        f"{100 * error:.1f}",
        worst,
        f"{100 * extreme(row, 'sequential_error', max)[0]:.1f}",
        f"{100 * equal['power']:.0f}",
        f"{equal['effect_ratio']:.3g}",
        f"{spent['seeds']:.1f}",
        f"{100 * spent['decided']:.0f}/{100 * spent['decided_at_once']:.0f}",
    ]


def markdown(rows: Sequence[dict[str, Any]]) -> str:
    lines = [HEADER, ["---" if name == "of" else "---:" for name in HEADER], *map(columns, rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


@click.command()
@click.option("--tables", default=5000, show_default=True, help="Simulated tables of each cell of the grid.")
@click.option("--seed", default=0, show_default=True, help="Seed of the random numbers.")
def main(tables: int, seed: int) -> None:
    """Print the table of docs/results/verdicts.md for a grid of seeds, clips, groups and variance shares.

    Exits with 1 where a cell breaks a promise by more than two standard errors of the simulation.
    """
    cells = grid()
    rows = [simulate(cell, tables, seed) for cell in progress_bar(cells, "simulating")]
    click.echo(markdown(rows))
    failures = [
        f"broken at {cell.seeds} seeds x {cell.clips} clips, {cell.size} a group: {problem}"
        for cell, row in zip(cells, rows, strict=True)
        for problem in broken(row, cell.capped)
    ]
    click.echo("\n".join(failures))
    raise SystemExit(bool(failures))


if __name__ == "__main__":
    main()
