"""Simulate tables with few groups, such as persons, and count false claims of all kinds of p-values.

docs/results/verdicts.md has the output. Axes of arrays: K comparisons, S seeds, G groups, R resamples.
"""

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence

import click
import numpy as np

from memmlp.common.progress import progress_bar
from memmlp.report.tables.statistics import LEVEL, compute_bootstrap_p, estimate_error

GROUPS, SEEDS, COMPARISONS = (8, 9, 14, 30), (2, 5, 10, 20), (1, 12, 112)
SHAPES = {
    "normal": lambda rng, size: rng.normal(size=size),
    "heavy tails": lambda rng, size: rng.standard_t(3, size) / np.sqrt(3),
    "skewed errors": lambda rng, size: (rng.exponential(size=size) - rng.exponential(size=size)) / np.sqrt(2),
    "skewed differences": lambda rng, size: rng.exponential(size=size) - 1,
}
"""The person effects: differences with mean 0 and variance 1. Skewed errors of interchangeable variants have
symmetric differences."""
SHARES = ((0, 1, 0), (1, 1, 0), (1, 1, 1), (0, 0, 1), (1, 0, 0))
"""The shares of seeds, persons and noise in the variance of the mean."""
BOOTSTRAP_SHARES = (*SHARES, (1, 0, 1), (4, 1, 0), (10, 1, 0), (30, 1, 0), (10, 0, 1))
"""Those for the bootstrap p-value, which depends on the ratio of seed and person effects."""
MOST = 0.06  # the largest family-wise error
RESAMPLES = 4096
CHUNK = 4000  # comparisons that are drawn at once, which bounds the memory


def draw_differences(
    rng: np.random.Generator, comparisons: int, seeds: int, groups: int, shape: str, shares: Sequence[float]
) -> np.ndarray:
    """Draw differences (K, S, G) without a true effect, from seed effects, person effects and noise."""
    of_seeds, of_groups, noise = np.sqrt(np.array(shares) / sum(shares))
    return (
        of_seeds * np.sqrt(seeds) * rng.normal(size=(comparisons, seeds, 1))
        + of_groups * np.sqrt(groups) * SHAPES[shape](rng, (comparisons, 1, groups))
        + noise * np.sqrt(seeds * groups) * rng.normal(size=(comparisons, seeds, groups))
    )


def count_claims(
    rng: np.random.Generator, seeds: int, groups: int, tables: int, shape: str, shares: Sequence[float]
) -> Iterator[float]:
    """Yield the family-wise error of p for each number of COMPARISONS.

    All nulls are true, so Holm makes a claim exactly if its first step does. Comparisons are independent.
    There are ten times as many tables of one comparison.
    """
    for size in COMPARISONS:
        step, number = max(1, CHUNK // size), 10 * tables if size == 1 else tables
        claims: list[np.ndarray] = []
        for start in range(0, number, step):
            comparisons = size * min(step, number - start)
            differences = draw_differences(rng, comparisons, seeds, groups, shape, shares)
            half = estimate_error(differences).compute_half_width(LEVEL / size)
            claims.append((np.abs(differences.mean((1, 2))) > half).reshape(-1, size).any(1))
        yield float(np.concatenate(claims).mean())


def count_bootstrap_claims(
    rng: np.random.Generator, seeds: int, groups: int, tables: int, shape: str, shares: Sequence[float]
) -> Iterator[float]:
    """Yield the family-wise error of the bootstrap p-value for each number of COMPARISONS, from the error of
    one comparison. Comparisons with a far larger p are skipped, since they have no small bootstrap p."""
    for size in COMPARISONS:
        claims, number = 0, tables * (10 if size < 100 else 50)
        for _ in range(0, number, CHUNK):
            differences = draw_differences(rng, CHUNK, seeds, groups, shape, shares)
            half = estimate_error(differences).compute_half_width(min(0.15, 10 * LEVEL / size))
            small = differences[np.abs(differences.mean((1, 2))) > half]
            claims += np.sum(compute_bootstrap_p(small) <= LEVEL / size) if len(small) else 0
        yield float(1 - (1 - claims / (-(-number // CHUNK) * CHUNK)) ** size)


def simulate(
    groups: int, seeds: int, tables: int, seed: int, count: Callable[..., Iterator[float]] = count_claims
) -> dict[int, tuple[float, str]]:
    """Return the largest family-wise error, and its cell, for each number of COMPARISONS."""
    rng, found = np.random.default_rng([seed, groups, seeds]), []
    for shape, shares in itertools.product(SHAPES, SHARES if count is count_claims else BOOTSTRAP_SHARES):
        if shape == "normal" or shares[1]:
            errors = count(rng, seeds, groups, tables, shape, shares)
            found.append([(error, f"{shape} {shares}") for error in errors])
    return dict(zip(COMPARISONS, map(max, zip(*found, strict=True)), strict=True))


def find_broken(errors: Iterable[float], tables: int) -> bool:
    """Return whether a family-wise error exceeds MOST by over two standard errors."""
    return max(errors) > MOST + 2 * np.sqrt(MOST * (1 - MOST) / tables)


def compute_resampled_p(rng: np.random.Generator, values: np.ndarray) -> dict[str, np.ndarray]:
    """Return p-values (K,) of three resampling tests of the mean 0, for values (K, G), by name.

    Sign flips of the mean; sign flips of Hall's skew-corrected t; and the symmetric bootstrap-t.
    """
    groups = values.shape[1]
    signs = rng.choice([-1.0, 1.0], (RESAMPLES, groups))
    if 2 ** (groups - 1) <= RESAMPLES:
        signs = 1.0 - 2 * (np.arange(2 ** (groups - 1))[:, None] >> np.arange(groups) & 1)
    signs[0] = 1
    counts = rng.multinomial(groups, np.full(groups, 1 / groups), RESAMPLES).astype(float)
    mean = values.mean(1, keepdims=True)
    centred = values - mean
    means, squares = values @ signs.T / groups, (values**2).mean(1, keepdims=True)
    cubes = (values**3) @ signs.T / groups - 3 * means * squares + 2 * means**3
    spread = np.sqrt(squares - means**2)
    skew, t = cubes / spread**3, means / spread
    hall = np.abs(t + skew * t**2 / 3 + skew**2 * t**3 / 27 + skew / (6 * groups))
    drawn = centred @ counts.T / groups
    variance = np.maximum(centred**2 @ counts.T / groups - drawn**2, 1e-12)
    larger = np.abs(drawn) / np.sqrt(variance) >= np.abs(mean) / centred.std(1, keepdims=True)
    return {
        "flips": (np.abs(means) >= np.abs(mean) * (1 - 1e-9)).mean(1),
        "flips of skew-corrected t": (hall >= hall[:, :1] * (1 - 1e-9)).mean(1),
        "bootstrap-t": (larger.sum(1) + 1) / (RESAMPLES + 1),
    }


def simulate_resampling(shape: str, groups: int, comparisons: int, seed: int) -> dict[str, list[float]]:
    """Return family-wise errors of p and the resampled p-values, for each number of COMPARISONS, by name.

    Only persons differ. One comparison's error gives the errors of independent comparisons.
    """
    rng, found = np.random.default_rng([seed, groups]), []
    for _ in range(0, comparisons, 500):
        values = draw_differences(rng, 500, 2, groups, shape, (0, 1, 0))
        known, mean = estimate_error(values), np.abs(values.mean((1, 2)))
        found.append({"p": known.compute_significance_level(mean), **compute_resampled_p(rng, values[:, 0])})
    merged = {name: np.concatenate([one[name] for one in found]) for name in found[0]}
    return {
        name: [float(1 - (p > LEVEL / size).mean() ** size) for size in COMPARISONS]
        for name, p in merged.items()
    }


def format_row(head: str, errors: Iterable[float]) -> str:
    """Return a row of a Markdown table, with errors in %."""
    return f"| {' | '.join([head, *(f'{100 * error:.1f}' for error in errors)])} |"


@click.command()
@click.option("--tables", default=2000, show_default=True, help="Simulated tables of each cell.")
@click.option("--seed", default=0, show_default=True, help="Seed of the random numbers.")
@click.option(
    "--resampling", is_flag=True, help="Compare with resampled p-values, in 10 x TABLES comparisons."
)
@click.option("--bootstrap", is_flag=True, help="Count claims of the bootstrap p-value.")
def main(tables: int, seed: int, resampling: bool, bootstrap: bool) -> None:
    """Print a table of docs/results/verdicts.md for few groups; exit with 1 if a promise is broken."""
    if resampling:
        for shape, groups in itertools.product(("skewed differences", "normal"), (8, 14, 30)):
            for name, errors in simulate_resampling(shape, groups, 10 * tables, seed).items():
                click.echo(format_row(f"{shape} | {groups} | {name}", errors))
        return
    broken = False
    for groups, seeds in progress_bar(list(itertools.product(GROUPS, SEEDS)), "simulating"):
        count = count_bootstrap_claims if bootstrap else count_claims
        errors, cells = zip(*simulate(groups, seeds, tables, seed, count).values(), strict=True)
        click.echo(format_row(f"{seeds} x {groups}", errors))
        click.echo(f"  {'; '.join(cells)}", err=True)
        broken |= find_broken(errors, tables)
    raise SystemExit(broken)


if __name__ == "__main__":
    main()
