"""`memmlp bench verdicts`: simulate tables to see whether the verdicts' promises are kept."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from memmlp.tables.statistics.paired_differences import LEVEL
from memmlp.tables.statistics.verdict_error_rates import (
    EFFECT,
    MARGIN,
    TABLE,
    broken,
    extreme,
    grid,
    simulate,
)

if TYPE_CHECKING:
    from rich.table import Table

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
        f"seeds: of an arm, in looks, with equal shares, where every other arm differs by {EFFECT:.0f} "
        f"standard errors and {MARGIN:.0f} are of interest; decided: comparisons, in %, so / at once",
    ]


def table(rows: Sequence[dict[str, Any]]) -> Table:
    """Return the rows as a table for a terminal."""
    from rich import box
    from rich.table import Table

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
    from rich.console import Console

    from memmlp.common.errors import InputError
    from memmlp.common.files import write_json
    from memmlp.common.progress import progress_bar

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
