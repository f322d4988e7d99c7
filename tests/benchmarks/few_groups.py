"""Simulate tables with few groups, such as persons, and count false claims of both kinds of p-values.

docs/results/verdicts.md has the output of `python tests/benchmarks/few_groups.py --tables 2000 --seed 20253`.
Axes of arrays: K comparisons, S seeds, G groups.
"""

import itertools
from collections.abc import Iterator, Sequence

import click
import numpy as np

from memmlp.common.progress import progress_bar
from memmlp.report.tables.statistics import LEVEL, Error, draw_signs, estimate_error

GROUPS, SEEDS, COMPARISONS = (8, 9, 14, 30), (2, 5, 10, 20), (1, 12, 112)
SHAPES = {
    "normal": lambda rng, size: rng.normal(size=size),
    "heavy tails": lambda rng, size: rng.standard_t(3, size) / np.sqrt(3),
    "skewed errors": lambda rng, size: (rng.exponential(size=size) - rng.exponential(size=size)) / np.sqrt(2),
    "skewed differences": lambda rng, size: rng.exponential(size=size) - 1,
}
"""The person effects: differences with mean 0 and variance 1. Skewed errors of interchangeable variants have
symmetric differences."""
SKEWED = "skewed differences"
SHARES = ((0, 1, 0), (1, 1, 0), (1, 1, 1), (0, 0, 1), (1, 0, 0))
"""The shares of seeds, persons and noise in the variance of the mean."""
MOST = 0.06  # the largest family-wise error
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


def is_significant_by_flips(differences: np.ndarray, known: Error, level: float) -> np.ndarray:
    """Return whether `compute_flip_p` is at most `level`, for each comparison (K,).

    One level needs only the number of flips that exceed a limit. A comparison is out as soon as a part of the
    flips exceeds it too often, so most comparisons need few flips.
    """
    means, signs = differences.mean(1) / differences.shape[2], draw_signs(differences.shape[2])
    most = int(level * len(signs) * (1 + 1e-9))
    a, _, e = known.variances
    half = Error(np.stack([a, 0 * a, 0 * a]), known.seeds, known.groups).compute_half_width(level)
    total = means.sum(1) ** 2
    quantiles = [
        Error(np.array([[1.0], [0], [0]]), freedom, 1).compute_half_width(level)[0] ** 2
        for freedom in (known.seeds, known.groups)
    ]
    limit = total - np.maximum(half**2 - min(quantiles) * e, 0)
    left = np.flatnonzero((total > half**2) & (limit > 0)) if most else np.array([], int)
    counts = np.zeros(len(total), int)
    for part in np.split(signs, [n for n in (256, 2048) if n < len(signs)]):
        flipped = (means[left] @ part.T) ** 2
        counts[left] += (flipped >= limit[left, None] * (1 - 1e-9)).sum(1)
        left = left[counts[left] <= most]
    return np.isin(np.arange(len(total)), left)


def count_claims(
    rng: np.random.Generator, seeds: int, groups: int, tables: int, shape: str, shares: Sequence[float]
) -> Iterator[tuple[float, float]]:
    """Yield the family-wise errors of Student's t and of sign flips, for each number of COMPARISONS.

    All nulls are true, so Holm makes a claim exactly if its first step does. Comparisons are independent.
    There are ten times as many tables of one comparison.
    Tables of one comparison are ten times as many.
    """
    for size in COMPARISONS:
        step, number = max(1, CHUNK // size), 10 * tables if size == 1 else tables
        claims: list[np.ndarray] = []
        for start in range(0, number, step):
            comparisons = size * min(step, number - start)
            differences = draw_differences(rng, comparisons, seeds, groups, shape, shares)
            known, level = estimate_error(differences), LEVEL / size
            student = np.abs(differences.mean((1, 2))) > known.compute_half_width(level)
            flips = is_significant_by_flips(differences, known, level)
            claims.append(np.stack([student, flips]).reshape(2, -1, size).any(2))
        student, flips = np.concatenate(claims, axis=1).mean(1)
        yield float(student), float(flips)


def simulate(groups: int, seeds: int, tables: int, seed: int) -> dict[str, list[float]]:
    """Return the largest family-wise errors over SHARES for each number of COMPARISONS, by column."""
    rng = np.random.default_rng([seed, groups, seeds])
    worst = {name: np.zeros(len(COMPARISONS)) for name in ("t", "flips", SKEWED)}
    for shape, shares in itertools.product(SHAPES, SHARES):
        if shape != "normal" and not shares[1]:
            continue
        student, flips = np.array(list(count_claims(rng, seeds, groups, tables, shape, shares))).T
        column = SKEWED if shape == SKEWED else "flips"
        worst["t"] = np.maximum(worst["t"], student)
        worst[column] = np.maximum(worst[column], flips)
    return {name: errors.tolist() for name, errors in worst.items()}


def find_broken(errors: dict[str, list[float]], tables: int) -> bool:
    """Return whether t, or flips of symmetric differences, exceed MOST by over two standard errors."""
    limit = MOST + 2 * np.sqrt(MOST * (1 - MOST) / tables)
    return bool(max(*errors["t"], *errors["flips"]) > limit)


def make_row(groups: int, seeds: int, errors: dict[str, list[float]]) -> str:
    """Return a row of the table, with errors in %."""
    numbers = [f"{100 * error:.1f}" for column in errors.values() for error in column]
    return f"| {' | '.join([f'{seeds} x {groups}', *numbers])} |"


@click.command()
@click.option("--tables", default=2000, show_default=True, help="Simulated tables of each cell.")
@click.option("--seed", default=0, show_default=True, help="Seed of the random numbers.")
def main(tables: int, seed: int) -> None:
    """Print the table of docs/results/verdicts.md for few groups; exit with 1 if a promise is broken."""
    heads = [f"{name}, {size}" for name in ("t", "flips", "flips, skewed") for size in COMPARISONS]
    click.echo(f"| seeds x groups | {' | '.join(heads)} |\n|{' ---: |' * (len(heads) + 1)}")
    broken = False
    for groups, seeds in progress_bar(list(itertools.product(GROUPS, SEEDS)), "simulating"):
        errors = simulate(groups, seeds, tables, seed)
        click.echo(make_row(groups, seeds, errors))
        broken |= find_broken(errors, tables)
    raise SystemExit(broken)


if __name__ == "__main__":
    main()
