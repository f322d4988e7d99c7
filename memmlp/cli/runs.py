"""`memmlp runs`: list, show and compare run folders."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich import box
from rich.console import Console
from rich.table import Table

from memmlp.cli.options import outputs_option

if TYPE_CHECKING:
    from memmlp.runs.run import Run

NEWEST = 20
SHOWN = {
    # the column's head -> the path of its number in results.json
    "stream\ncm": ("stream", "rotation", "MPJPE"),
    "window\ncm": ("window", "rotation", "MPJPE"),
    "jitter": ("stream", "rotation", "Jitter"),
    "ms": ("latency", "median_ms"),
}


@click.group("runs")
def runs() -> None:
    """List, show and compare runs."""


@runs.command("list")
@click.option("--all", "every", is_flag=True, help=f"List all runs, and not only the newest {NEWEST}.")
@outputs_option
def list_command(every: bool, outputs: Path) -> None:
    """List the runs, the newest first.

    Shown are the MPJPE of the rotation branch in both modes, Jitter, and the latency of a frame.
    """
    from memmlp.runs.lookup import list_runs

    found = list_runs(outputs)
    if not found:
        click.echo(f"no runs in {outputs / 'runs'}; memmlp demo makes the first")
        return
    table = _table("run", "kind", "status", "age")
    for column in SHOWN:
        table.add_column(column, justify="right", no_wrap=True)
    for run in found if every else found[:NEWEST]:
        numbers = (_number(run.results, path) for path in SHOWN.values())
        table.add_row(run.id, run.manifest.get("kind", "-"), run.status, _age(run), *numbers)
    _console().print(table)
    if len(found) > NEWEST and not every:
        click.echo(f"{len(found) - NEWEST} older ones: memmlp runs list --all")


@runs.command("show")
@click.argument("run")
@click.option("--config", "config", is_flag=True, help="Print the run's resolved config, too.")
@outputs_option
def show_command(run: str, config: bool, outputs: Path) -> None:
    """Show one run and its results.

    RUN is its id, the beginning of it, or its folder.
    """
    from memmlp.runs.identity import flatten
    from memmlp.runs.lookup import find_run, is_trained
    from memmlp.tables.measured_run import load

    found = find_run(outputs, run)
    changed = ", ".join(found.verify())
    facts = {"run": found.id, "folder": found.folder, "status": found.status} | flatten(found.manifest)
    if changed:
        facts["changed since"] = changed
    facts.pop("id", None)
    _console().print(_pairs(facts))
    if found.results:
        _console().print(_pairs(flatten(found.results), title="results"))
    if is_trained(found):
        for source, measured in load(found.folder).by_source().items():
            _console().print(_pairs(flatten(measured.means), title=f"results on {source}"))
    if config and found.config:
        _console().print(_pairs(flatten(found.config), title="config"))


@runs.command("diff")
@click.argument("a")
@click.argument("b")
@outputs_option
def diff_command(a: str, b: str, outputs: Path) -> None:
    """Show in what two runs differ.

    Their configs and results are compared.
    """
    from memmlp.runs.lookup import diff, find_run

    first, second = find_run(outputs, a), find_run(outputs, b)
    differences = diff(first, second)
    for title, pairs in (("config", differences.config), ("results", differences.results)):
        if not pairs:
            click.echo(f"{title}: no difference")
            continue
        table = _table(title, first.id, second.id)
        for key, values in pairs.items():
            table.add_row(key, *map(_text, values))
        _console().print(table)


def _console() -> Console:
    return Console(highlight=False, markup=False)


def _table(*columns: str, title: str | None = None) -> Table:
    """Make a table without a border; long values fold, and no word is cut."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, title=title, title_justify="left")
    for column in columns:
        table.add_column(column, overflow="fold")
    return table


def _pairs(facts: Mapping[str, Any], title: str | None = None) -> Table:
    """Make a table of keys and values."""
    table = _table("", "", title=title)
    table.show_header = False
    for key, value in facts.items():
        table.add_row(key, _text(value))
    return table


def _text(value: Any) -> str:
    """Return a value in few characters."""
    if isinstance(value, float):
        return f"{value:.4g}"
    return "-" if value is None else str(value)


def _number(results: Mapping[str, Any], path: tuple[str, ...]) -> str:
    """Return the number at a path of nested results as text; "-" where there is none."""
    value: Any = results
    for key in path:
        value = value.get(key) if isinstance(value, Mapping) else None
    return f"{value:.2f}" if isinstance(value, int | float) else "-"


def _age(run: Run) -> str:
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
