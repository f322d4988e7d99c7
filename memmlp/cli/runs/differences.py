"""`memmlp runs diff`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from memmlp.cli.options import outputs_option
from memmlp.cli.runs.printing import (
    console,
    measured_numbers,
    older_results,
    plain_table,
    recorded,
    text_of,
    value_text,
)
from memmlp.evaluation.metric_facts import UNITS

if TYPE_CHECKING:
    from memmlp.runs.run import Run

SHORT = 8  # characters of an id above a column of numbers, which leave the keys a line of 80
ORIGIN = (
    "device",
    "gpu",
    "threads",
    "processes",
    "precision",
    "version",
    "git",
    "python",
    "packages",
    "recipes",
)


@click.command("diff")
@click.argument("a")
@click.argument("b")
@outputs_option
def diff(a: str, b: str, outputs: Path) -> None:
    """Show in what two runs differ.

    Compared are the keys of their configs that change a result, their data, what was measured, and code and
    machine. The difference is how much more B has than A.
    """
    from memmlp.runs.lookup import find_run
    from memmlp.runs.motion_seen import frames_seen, hardly_trained

    first, second = find_run(outputs, a), find_run(outputs, b)
    for title, rows in (("config", config_rows(first, second)), ("results", result_rows(first, second))):
        if not rows:
            click.echo(f"{title}: no difference")
            continue
        ids = (first.id, second.id) if title == "config" else (first.id[:SHORT], second.id[:SHORT])
        table = plain_table(title, *ids, *(["change", "unit"] if title == "results" else []))
        for column in table.columns[1:] if title == "results" else table.columns[:1]:
            column.no_wrap = True  # a number in two lines is none, and half of one is another
        for row in rows:
            table.add_row(*row)
        console().print(table)
        if title == "results":
            click.echo("one run of each: such changes may be chance; memmlp sweep compares over seeds")
    for run in (first, second):
        if hardly := hardly_trained(frames_seen(run)):
            click.echo(f"run {run.id[:SHORT]}: {hardly}")
    if (one := first.manifest.get("data")) != (two := second.manifest.get("data")) and one and two:
        click.echo("their data differs, so that errors are those of other test clips")
    if rows := origin_rows(first, second):
        table = plain_table("made by", first.id, second.id)
        for row in rows:
            table.add_row(*row)
        console().print(table)


def origin_rows(first: Run, second: Run) -> list[tuple[str, ...]]:
    """Return a row for every difference in code and machine that may change numbers despite equal configs."""
    from memmlp.runs.deployment_folder import timed_on
    from memmlp.runs.identity import flatten

    a, b = (
        flatten({key: run.manifest.get(key) for key in ORIGIN})
        | {"latency": timed_on(run.deployment_as_configured.record), **older_results(run)}
        for run in (first, second)
    )
    used = {key for key in a | b if not key.startswith("recipes.") or (key in a and key in b)}
    return [
        (key, text_of(a.get(key)), text_of(b.get(key)))
        for key in a | b
        if key in used and a.get(key) != b.get(key)
    ]


def config_rows(first: Run, second: Run) -> list[tuple[str, ...]]:
    """Return a row for each differing key of the config, or the data, that changes a result."""
    from memmlp.runs.query import data_labels, differing

    pair = [recorded(run) for run in (first, second)]
    digests = [str(one.get("data_digest")) for one in pair]
    keys = differing([run.config for run in (first, second)], digests)
    rows = [(key, *(value_text(one, key, whole=False) for one in pair)) for key in keys]
    return rows if len(set(digests)) == 1 else [("data", *data_labels(pair)), *rows]


def result_rows(first: Run, second: Run) -> list[tuple[str, ...]]:
    """Return a row for each measured number that differs: its key, both values, the change, and its unit."""
    a, b = measured_numbers(first), measured_numbers(second)
    keys = [key for key in a | b if a.get(key) != b.get(key)]
    return [
        (
            key,
            text_of(a.get(key)),
            text_of(b.get(key)),
            f"{b[key] - a[key]:+.4g}" if key in a and key in b else "-",
            UNITS.get(key.rpartition(".")[2], "ms" if key.endswith("_ms") else ""),
        )
        for key in keys
    ]
