"""Simulated tables whose truth is known: how often verdicts are wrong, beside what the statistics promise.

Run `python tests/benchmarks/verdicts.py --tables 5000 --seed 20253 --markdown`; docs/results/verdicts.md has
what it printed. Axes of arrays: K comparisons (T tables of TABLE each), S seeds, C clips, G groups of clips.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import click
import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table
from scipy.special import ndtri

from memmlp.common.errors import InputError
from memmlp.common.files import write_json
from memmlp.common.progress import progress_bar
from memmlp.report.tables.statistics import (
    LEVEL,
    Error,
    analysis_schedule,
    by_group,
    holm,
    sequential,
    spending,
)


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
        variance: the variance E (K,) of the noise alone (`paired_differences`).
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
        self.looks = {
            n: self._look(fixed, noise[:, :n], variances[:, :n]) for n in analysis_schedule(cell.seeds)
        }

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


SEEDS, CLIPS, SIZES = (2, 3, 5, 10), (4, 10, 40, 536), (1, 2, 10)
VARIANTS, METRICS = 6, 4
TABLE = VARIANTS * METRICS  # comparisons of a table
CHUNK = 4_000_000  # numbers that are drawn at once, which bounds the memory

ERROR, LEAST, MOST = 0.06, 0.93, 0.995
"""The promises that are tested.

A family-wise error of at most ERROR and a coverage of at least LEAST everywhere; from 3 seeds and 5 groups on
also a coverage of at most MOST, so that intervals are not too wide.
"""

MARGIN, EFFECT = 8.0, 16.0
"""The smallest effect of interest, and the effect that half of the variants have in simulated campaigns.

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
        seeds: the number of seeds that each variant spent (T, VARIANTS).
        decided: whether each comparison was decided in looks (T, TABLE).
        at_once: whether each is decided with all seeds at once (T, TABLE).
        false: whether a table made any false claim in looks (T,).
    """

    seeds: np.ndarray
    decided: np.ndarray
    at_once: np.ndarray
    false: np.ndarray


def campaign(sample: Simulated, shares: Shares) -> Campaign:
    """Simulate tables that are looked at with more and more seeds; half of the variants differ by EFFECT.

    A variant stops when all of its comparisons are decided.
    """
    tables = len(sample.seeds) // TABLE
    truth = np.repeat(np.arange(VARIANTS) % 2 * EFFECT, METRICS)
    differ, same = np.zeros((2, tables, TABLE), bool)
    seeds = np.zeros((tables, VARIANTS), int)
    for number, level in spent(sample):
        seeds[~(differ | same).reshape(tables, VARIANTS, METRICS).all(2)] = number
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


QUICK = 40  # the largest number of clips with --quick

HEADER = (
    "design", "coverage", "star", "of", "looks", "power", "effect", "seeds", "decided",
)  # fmt: skip


def columns(row: dict[str, Any]) -> list[str]:
    """Return the words of a row of the printed table."""
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


def remarks(rows: Sequence[dict[str, Any]], seed: int) -> list[str]:
    """Return the lines that explain the columns."""
    tables = rows[0]["tables"]
    star, covered = (100 * np.sqrt(LEVEL * (1 - LEVEL) / number) for number in (tables, tables * TABLE))
    return [
        f"design: seeds x clips / clips of a group; {tables} tables of {TABLE} true nulls for each, and for "
        f"each of {len(rows[0]['shares'])} choices of shares of variance; seed {seed}",
        f"coverage: of the 95 % interval, least and most over shares, in % (standard error {covered:.2f})",
        f"star: tables with any after Holm, in % (standard error {star:.2f}), and the shares with the most; "
        "looks: the same, where seeds are added in looks; the worst of many cells is above its true rate",
        "power: in %, of an effect that an oracle, who knows the variances, finds in 80 %; effect: found in "
        "80 %, over the oracle's; both with equal shares, at Holm's first step",
        f"seeds: of a variant, in looks, with equal shares; every other variant differs by {EFFECT:.0f} "
        f"standard errors and {MARGIN:.0f} are of interest; decided: comparisons, in %, so / at once",
    ]


def table(rows: Sequence[dict[str, Any]]) -> Table:
    """Return the rows as a table for a terminal."""
    shown = Table(box=box.SIMPLE_HEAD, padding=0)
    for name in HEADER:
        shown.add_column(name, justify="left" if name == "of" else "right", no_wrap=True)
    for row, after in itertools.zip_longest(rows, rows[1:]):
        shown.add_row(*columns(row), end_section=bool(after) and after["seeds"] != row["seeds"])
    return shown


def markdown(rows: Sequence[dict[str, Any]], seed: int) -> str:
    """Return the rows and remarks as Markdown, for docs/results/verdicts.md."""
    lines = [HEADER, ["---" if name == "of" else "---:" for name in HEADER], *map(columns, rows)]
    text = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    return "\n".join([text, "", *(f"- {line}" for line in remarks(rows, seed))]) + "\n"


@click.command("verdicts")
@click.option(
    "--tables",
    default=5000,
    show_default=True,
    type=click.IntRange(1),
    help="How many tables are simulated for each cell of the grid.",
)
@click.option("--quick", is_flag=True, help=f"Simulate the cells of at most {QUICK} clips alone.")
@click.option("--seed", default=0, show_default=True, help="Seed of the random numbers.")
@click.option(
    "--json", "file", type=click.Path(path_type=Path), help="File to write all rates into, as JSON."
)
@click.option("--markdown", "as_markdown", is_flag=True, help="Print the table as Markdown.")
def verdicts(tables: int, quick: bool, seed: int, file: Path | None, as_markdown: bool) -> None:
    """Simulate how often verdicts are wrong.

    The simulation covers a grid of seeds, clips, groups and shares of variance. Exits with 1 where a cell
    breaks a promise by more than two standard errors of the simulation.
    """
    if file and not file.absolute().parent.is_dir():
        raise InputError(f"--json {file}: there is no folder {file.parent}")
    cells = [cell for cell in grid() if not quick or cell.clips <= QUICK]
    rows = [simulate(cell, tables, seed) for cell in progress_bar(cells, "simulating")]
    if file:
        write_json(file, {"seed": seed, "level": LEVEL, "comparisons": TABLE, "cells": rows})
    if as_markdown:
        click.echo(markdown(rows, seed))
    else:
        Console().print(table(rows), *remarks(rows, seed), sep="\n")
    failures = {cell: broken(row, cell.capped) for cell, row in zip(cells, rows, strict=True)}
    for cell, problems in failures.items():
        for problem in problems:
            click.echo(f"broken at {cell.seeds} seeds x {cell.clips} clips, {cell.size} a group: {problem}")
    if any(failures.values()):
        raise SystemExit(1)


if __name__ == "__main__":
    verdicts()
