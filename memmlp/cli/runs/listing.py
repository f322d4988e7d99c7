"""`memmlp runs list`."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich.console import Console
from rich.table import Table

from memmlp.cli.options import outputs_option
from memmlp.cli.runs.show import SHORT, age, console, outdated_results, plain_table, record_of, value_text
from memmlp.evaluation.metric_facts import UNITS
from memmlp.runs.identity import NETWORK
from memmlp.runs.lookup import describe_kind

if TYPE_CHECKING:
    from memmlp.runs.query import Record
    from memmlp.runs.run import Run

NEWEST = 20
RESULTS = {
    # the column's head -> the key of its number
    "MPJPE\nstream": "stream.rotation.MPJPE",
    "MPJPE\nwindow": "window.rotation.MPJPE",
    "Jitter\nstream": "stream.rotation.Jitter",
    "ms": "latency.median_ms",
}
LEGEND = f"MPJPE [{UNITS['MPJPE']}], Jitter [{UNITS['Jitter']}]: rotation branch; ms: a frame on one core"
EXPENDABLE = ("ms", "age", "Jitter\nstream", "MPJPE\nwindow")  # left out first on a narrow screen
KEYS = 4  # differing keys that have columns, if nobody asked for them
NAMED = 4  # keys without a column that are named below the table
NAME = 31  # characters of a run's name in a line, at least


@click.command("list")
@click.option(
    "--all", "every", is_flag=True, help=f"List all: VQ-VAEs and parts too, and more than {NEWEST}."
)
@click.option(
    "--where", help="List the runs that fulfil a condition, such as 'memory=gru and stream.MPJPE<6.3'."
)
@click.option("--sort", help="Sort by a key, such as stream.MPJPE; -KEY begins with the largest.")
@click.option("--columns", help="Show these keys, separated by commas.  [default: config keys that differ]")
@outputs_option
def list_runs(every: bool, where: str | None, sort: str | None, columns: str | None, outputs: Path) -> None:
    """List the runs, the newest first; finished runs of VQ-VAEs and of networks' parts are hidden (--all).

    Shown are their names and data, the config keys that differ, the MPJPE of the rotation branch in both
    modes, Jitter, and the latency of a frame. Keys are those of the config (`memory`, `optim.lr`), results
    (`stream.MPJPE`, `window.position.Jitter`, `latency.median_ms`), and `id`, `kind`, `status`, `name`,
    `data`, `started`, `tag`, `note`.
    """
    from memmlp.runs import lookup
    from memmlp.runs.query import parse_query

    query = parse_query(where) if where else None
    runs = lookup.list_runs(outputs)
    if not runs:
        hint = "memmlp demo makes the first; --outputs FOLDER or MEMMLP_OUTPUTS names another folder"
        click.echo(f"no runs in {outputs.absolute() / 'runs'}: {hint}")
        return
    found = runs if every or query else [run for run in runs if not _is_finished_part(run)]
    newest = found if every or query or sort else found[:NEWEST]
    records = {run.id: record_of(run) for run in newest}
    fits = query.test_records(list(records.values())) if query else [True] * len(records)
    listed = [run for run, fit in zip(newest, fits, strict=True) if fit]
    if sort:
        listed = _sorted_by(listed, records, sort)
    keys = _chosen_keys(columns, records, listed)
    rows = [{**records[run.id], "age": age(run)} for run in listed]
    hidden = _print_table(rows, keys, asked=columns is not None)
    for line in (*_outdated_lines(listed), *_hardly_trained_lines(listed)):
        click.echo(line)
    if hidden:
        more = f" and {len(hidden) - NAMED} more keys" if len(hidden) > NAMED else ""
        option = ",".join(["name", *hidden[:NAMED], "stream.MPJPE"])
        click.echo(f"they also differ in {', '.join(hidden[:NAMED])}{more}: --columns {option}")
    if parts := Counter(describe_kind(run.manifest["kind"]) for run in runs if run not in found):
        counts = ", ".join(f"{count} finished {word}" for word, count in parts.items())
        click.echo(f"{counts}: memmlp runs list --all")
    if len(found) > len(newest):
        click.echo(f"{len(found) - len(newest)} older ones: memmlp runs list --all")
    elif query:
        click.echo(f"{len(listed)} of {len(found)} runs")


def _outdated_lines(listed: Sequence[Run]) -> list[str]:
    """Return a line for each mode in which runs were measured by an earlier component version."""
    found: dict[tuple[str, str], list[str]] = {}
    for run in listed:
        for results in outdated_results(run).items():
            found.setdefault(results, []).append(run.id[:SHORT])
    return [
        f"{results} {by}; memmlp eval RUN measures them again: {_join(ids)}"
        for (results, by), ids in found.items()
    ]


def _hardly_trained_lines(listed: Sequence[Run]) -> list[str]:
    """Return a line that names the finished runs whose networks hardly saw motion, if there are any."""
    from memmlp.runs.lookup import count_training_frames, warn_if_hardly_trained

    networks = [run for run in listed if run.manifest.get("kind") == NETWORK and run.done]
    ids = [run.id[:SHORT] for run in networks if warn_if_hardly_trained(count_training_frames(run))]
    if not ids:
        return []
    names = "all finished runs" if len(ids) == len(networks) > 1 else _join(ids)
    return [f"hardly trained, ignore the errors: {names}"]


def _join(ids: Sequence[str]) -> str:
    more = f" and {len(ids) - NEWEST} more" if len(ids) > NEWEST else ""
    return ", ".join(ids[:NEWEST]) + more


def _is_finished_part(run: Run) -> bool:
    """Return whether a run is a finished VQ-VAE or part of a network, which does not have results to list."""
    return run.manifest.get("kind") not in (None, NETWORK) and run.done


def _sorted_by(listed: Sequence[Run], records: Mapping[str, Record], sort: str) -> list[Run]:
    """Return the runs sorted by a key; those without such a value, or with NaN, come last."""
    from memmlp.runs.query import check_key

    key, reverse = sort.removeprefix("-"), sort.startswith("-")
    check_key(key, records.values(), "--sort")
    values: dict[str, Any] = {run.id: records[run.id].get(key) for run in listed}
    known = [run for run in listed if values[run.id] not in (None, "", ()) and not _is_nan(values[run.id])]
    numbers = all(isinstance(values[run.id], int | float) for run in known)
    known.sort(key=lambda run: values[run.id] if numbers else str(values[run.id]), reverse=reverse)
    return [*known, *(run for run in listed if run not in known)]


def _is_nan(value: object) -> bool:
    return isinstance(value, float) and math.isnan(value)


def _chosen_keys(columns: str | None, records: Mapping[str, Record], listed: Sequence[Run]) -> list[str]:
    """Return the keys to show: those asked for, or those of the config that differ between finished runs."""
    from memmlp.runs.query import check_key, list_differing_keys

    if columns is not None:
        keys = [key.strip() for key in columns.split(",") if key.strip()]
        for key in keys:
            check_key(key, records.values(), "--columns")
        return keys
    networks = [run for run in listed if records[run.id].get("kind") == NETWORK]
    data = [str(records[run.id].get("data_digest")) for run in networks]
    return list_differing_keys([run.config for run in networks], data) if len(networks) > 1 else []


def _print_table(records: Sequence[Record], keys: Sequence[str], asked: bool) -> list[str]:
    """Print the runs as a table, and return the keys that did not fit.

    Args:
        records: the values that can be shown of each run, and its `age`.
        keys: the keys whose values are shown.
        asked: whether the user asked for these keys, so that all of them are shown, without results.
    """
    columns = _columns(records, keys, asked)
    expendable = ["age"] if asked else [*EXPENDABLE, *reversed(keys[:KEYS])]
    wide = Console(width=10_000)
    while (width := wide.measure(_table(columns, asked)).minimum) > console().width and expendable:
        columns.pop(expendable.pop(0), None)
    shown = Console(highlight=False, markup=False, width=max(console().width, width))
    shown.print(_table(columns, asked))
    return [key for key in keys if key not in columns]


def _columns(records: Sequence[Record], keys: Sequence[str], asked: bool) -> dict[str, list[str]]:
    """Return the texts of all columns by their heads."""
    from memmlp.runs.query import label_data

    columns = {"run": [one["id"] for one in records]}
    columns |= {head: [str(one.get(head) or "-") for one in records] for head in ("status", "age")}
    labels = label_data(records)
    if not asked:
        columns["name"] = [str(one.get("name") or "-") for one in records]
        if len(set(labels) - {"-"}) > 1:
            columns["data"] = labels
    for key in keys if asked else keys[:KEYS]:
        values = labels if key == "data" else [value_text(one, key, whole=asked) for one in records]
        columns[key] = list(values)
    if any(one.get("tag") for one in records):
        columns["tags"] = ["\n".join(one.get("tag", ())) for one in records]
    if not asked:
        columns |= {head: [shown_number(one, key) for one in records] for head, key in RESULTS.items()}
    return columns


def _table(columns: Mapping[str, Sequence[str]], asked: bool) -> Table:
    """Make the table of some columns, in which only names are wrapped."""
    table = plain_table()
    table.padding, table.show_edge = (0, 0), False
    table.caption_justify, table.caption_style = "left", ""
    table.caption = None if asked else LEGEND
    for head in columns:
        is_name, is_number = head == "name" and not asked, head in RESULTS and not asked
        table.add_column(
            head,
            justify="right" if is_number else "left",
            no_wrap=not is_name,
            min_width=NAME if is_name else None,
            overflow="fold",
        )
    for cells in zip(*columns.values(), strict=True):
        table.add_row(*cells)
    return table


def shown_number(record: Record, key: str) -> str:
    """Return a number as text; a time of another file than the config asks for with that file's name."""
    group, _, name = key.partition(".")
    others = (other for other in record if other.startswith(f"{group}-") and other.partition(".")[2] == name)
    shown = key if key in record else next(others, None)
    value = record[shown] if shown else None
    if shown is None or not isinstance(value, int | float):
        return "-"
    file = shown.partition(".")[0].removeprefix(group).removeprefix("-")
    return f"{value:.2f} {file}".rstrip()
