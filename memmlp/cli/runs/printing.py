"""Functions that the commands of runs share: a run's record, tables, and values as text."""

from __future__ import annotations

import re
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import click
from rich import box
from rich.console import Console
from rich.table import Table

from memmlp.common.errors import InputError

if TYPE_CHECKING:
    from memmlp.runs.query import Record
    from memmlp.runs.run import Run

LONGEST = 36  # characters of a value that nobody asked for


def recorded(run: Run) -> Record:
    """Return a run's record of values; of a run with a damaged file, only its id and status."""
    from memmlp.runs.query import record

    try:
        return record(run)
    except InputError as error:
        click.echo(f"memmlp: warning: {error}", err=True)
        return {"id": run.id, "status": "damaged"}


def value_text(record: Record, key: str, whole: bool) -> str:
    """Return a record's value as text; a long one is shortened unless the whole is wanted."""
    from memmlp.runs.query import as_typed

    text = as_typed(record[key]) if key in record else "-"
    return text if whole or len(text) <= LONGEST else f"{text[:LONGEST]}…"


def measured_numbers(run: Run) -> dict[str, Any]:
    """Return the numbers in a run's results by dotted key, with the names of inverse kinematics in these."""
    from memmlp.runs.deployment_folder import with_times_as_deployed
    from memmlp.runs.evaluation_file import with_solvers
    from memmlp.runs.identity import flatten

    results = with_solvers(
        run.results, run.evaluations_as_configured.combined_by
    )  # which hold settings and digests, too
    every = flatten(with_times_as_deployed(results))
    numbers = {key: value for key, value in every.items() if isinstance(value, int | float)}
    return {
        key: value for key, value in numbers.items() if not re.match(r"latency[^.]*\.(settings|made)", key)
    }


def older_results(run: Run) -> dict[str, str]:
    """Return in words which of a run's results were measured by earlier recipes; none for a damaged run."""
    try:
        found = run.evaluations_as_configured.outdated
    except InputError:  # which `recorded` tells
        return {}
    return {f"{mode} results": f"by an earlier recipe: {words}" for mode, words in found.items()}


def console() -> Console:
    """Make a console that prints texts unchanged."""
    return Console(highlight=False, markup=False)


def plain_table(*columns: str, title: str | None = None) -> Table:
    """Make a table without a border; long values are wrapped, and no word is cut."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, title=title, title_justify="left")
    for column in columns:
        table.add_column(column, overflow="fold")
    return table


def pairs(facts: Mapping[str, Any], title: str | None = None) -> Table:
    """Make a table of keys and values."""
    table = plain_table("", "", title=title)
    table.show_header = False
    for key, value in facts.items():
        table.add_row(key, text_of(value))
    return table


def text_of(value: Any) -> str:
    """Return a value as a short text."""
    if isinstance(value, float):
        return f"{value:.4g}"
    return "-" if value is None else str(value)


def number_text(value: Any) -> str:
    """Return a number as text; "-" if there is none."""
    return f"{value:.2f}" if isinstance(value, int | float) else "-"


def age(run: Run) -> str:
    """Return the time since the run started, in its largest whole unit."""
    try:
        started = datetime.fromisoformat(run.manifest.get("started", ""))
        seconds = (datetime.now(UTC) - started).total_seconds()
    except (TypeError, ValueError):
        return "-"
    for unit, size in (("d", 86400), ("h", 3600), ("min", 60)):
        if seconds >= size:
            return f"{int(seconds // size)} {unit}"
    return f"{int(max(seconds, 0))} s"
