"""`memmlp runs list`."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click
from rich.console import Console
from rich.table import Table

from memmlp.cli.options import outputs_option
from memmlp.cli.runs.printing import (
    age,
    console,
    number_text,
    older_results,
    plain_table,
    recorded,
    value_text,
)
from memmlp.evaluation.metric_facts import UNITS
from memmlp.runs.identity import NETWORK
from memmlp.runs.shown_name import kind_words

if TYPE_CHECKING:
    from memmlp.runs.query import Record
    from memmlp.runs.run import Run

NEWEST = 20
SHOWN = {
    # the column's head -> the key of its number
    "MPJPE\nstream": "stream.rotation.MPJPE",
    "MPJPE\nwindow": "window.rotation.MPJPE",
    "Jitter\nstream": "stream.rotation.Jitter",
    "ms": "latency.median_ms",
}
LEGEND = {
    # the beginning of a column's head -> what its numbers are
    "MPJPE": f"MPJPE [{UNITS['MPJPE']}]: rotation branch",
    "Jitter": f"Jitter [{UNITS['Jitter']}]: rotation branch",
    "ms": "ms: a frame on one core",
}
SPARED = (
    ("ms", "age"),
    ("Jitter\nstream", "MPJPE\nwindow"),
)  # what a narrow screen has no room for: first, and later
DEAR = 3  # keys that have room before the second half of these
TOLD = 4  # keys without room that are named below the table
FOLD = 12  # characters of a value in a line, where it can be broken
SHORT = 8  # characters of an id in a line below the table
NAME = 31  # characters of a run's name in a line


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

    Shown are their names and data, what differs between their configs, the MPJPE of the rotation branch in
    both modes, Jitter, and the latency of a frame. Keys are those of the config (`memory`, `optim.lr`),
    results (`stream.MPJPE`, `window.position.Jitter`, `latency.median_ms`), and `id`, `kind`, `status`,
    `name`, `data`, `started`, `tag`, `note`.
    """
    from memmlp.runs import lookup
    from memmlp.runs.query import parse

    query = parse(where) if where else None
    there = lookup.list_runs(outputs)
    if not there:
        told = "memmlp demo makes the first; --outputs FOLDER or MEMMLP_OUTPUTS names another folder"
        click.echo(f"no runs in {outputs.absolute() / 'runs'}: {told}")
        return
    found = there if every or query else [run for run in there if not is_finished_upstream(run)]
    limit = len(found) if every or query or sort else NEWEST
    records = {run.id: recorded(run) for run in found[:limit]}
    fits = query.of(list(records.values())) if query else [True] * len(records)
    listed = [run for run, fit in zip(found[:limit], fits, strict=True) if fit]
    if sort:
        listed = sorted_by(listed, records, sort)
    keys = wanted(columns, records, listed)
    hidden = show_runs([{**records[run.id], "age": age(run)} for run in listed], keys, bool(columns))
    for line in (*older_results_lines(listed), *hardly_trained_lines(listed)):
        click.echo(line)
    if hidden:
        more = f" and {len(hidden) - TOLD} keys more" if len(hidden) > TOLD else ""
        columns = ",".join(["name", *hidden[:TOLD], "stream.MPJPE"])
        click.echo(f"they differ in {', '.join(hidden[:TOLD])}{more}, too: --columns {columns}")
    if upstream := Counter(kind_words(run.manifest["kind"]) for run in there if run not in found):
        told = ", ".join(f"{count} finished {word}" for word, count in upstream.items())
        click.echo(f"{told}: memmlp runs list --all")
    if len(found) > limit:
        click.echo(f"{len(found) - limit} older ones: memmlp runs list --all")
    elif query:
        click.echo(f"{len(listed)} of {len(found)} runs")


def older_results_lines(listed: Sequence[Run]) -> list[str]:
    """Return a line for each mode in which runs were measured by an earlier recipe."""
    found: dict[tuple[str, str], list[str]] = {}
    for run in listed:
        for results, by in older_results(run).items():
            found.setdefault((results, by), []).append(run.id[:SHORT])
    return [
        f"{results} {by}; memmlp eval RUN measures them anew: {_some(ids)}"
        for (results, by), ids in found.items()
    ]


def hardly_trained_lines(listed: Sequence[Run]) -> list[str]:
    """Return a line that names the finished runs whose networks hardly saw motion; none if there are none."""
    from memmlp.runs.motion_seen import frames_seen, hardly_trained

    networks = [run for run in listed if run.manifest.get("kind") == NETWORK and run.done]
    ids = [run.id[:SHORT] for run in networks if hardly_trained(frames_seen(run))]
    if not ids:
        return []
    which = "all finished ones" if len(ids) == len(networks) > 1 else _some(ids)
    return [f"hardly trained, so that errors say nothing of the networks: {which}"]


def _some(ids: Sequence[str]) -> str:
    """List ids, the first few of many."""
    more = f" and {len(ids) - NEWEST} more" if len(ids) > NEWEST else ""
    return ", ".join(ids[:NEWEST]) + more


def is_finished_upstream(run: Run) -> bool:
    """Return whether a run is a finished VQ-VAE or part of a network, which has no results to list."""
    return run.manifest.get("kind") not in (None, NETWORK) and run.done


def sorted_by(listed: Sequence[Run], records: Mapping[str, Record], sort: str) -> list[Run]:
    """Return the runs sorted by a key; those without such a value, or with NaN, come last."""
    from memmlp.runs.query import check_key

    key, down = sort.removeprefix("-"), sort.startswith("-")
    check_key(key, records.values(), "--sort")
    found: dict[str, Any] = {run.id: records[run.id].get(key) for run in listed}
    known = [run for run in listed if not _is_missing(found[run.id])]
    numbers = all(isinstance(found[run.id], int | float) for run in known)
    ranked = sorted(known, key=lambda run: found[run.id] if numbers else str(found[run.id]), reverse=down)
    return [*ranked, *(run for run in listed if run not in known)]


def _is_missing(value: object) -> bool:
    """Return whether a value can't be sorted: it is missing, or NaN."""
    return value in (None, "", ()) or (isinstance(value, float) and math.isnan(value))


def wanted(columns: str | None, records: Mapping[str, Record], listed: Sequence[Run]) -> list[str]:
    """Return the keys to show: those asked for, or those of the config that differ between finished runs."""
    from memmlp.runs.query import check_key, differing

    if columns is not None:
        keys = [key.strip() for key in columns.split(",") if key.strip()]
        for key in keys:
            check_key(key, records.values(), "--columns")
        return keys
    networks = [run for run in listed if records[run.id].get("kind") == NETWORK]
    data = [str(records[run.id].get("data_digest")) for run in networks]
    return differing([run.config for run in networks], data) if len(networks) > 1 else []


class Column(NamedTuple):
    """A column of the list.

    Attributes:
        name: the column's head, or the key that it shows.
        cells: its text for each run.
        number: whether the cells are numbers.
    """

    name: str
    cells: list[str]
    number: bool = False


def show_runs(records: Sequence[Record], keys: Sequence[str], asked: bool) -> list[str]:
    """Print the runs as a table, and return the keys that did not fit.

    Args:
        records: the values that can be shown of each run, and its `age`.
        keys: the keys whose values are shown.
        asked: whether the user asked for these keys, so that all of them are shown, without results.
    """
    columns = list(_columns(records, keys, {} if asked else SHOWN))
    spare = [name for name in SPARED[0] if name not in keys]
    if not asked:  # never the name, which tells what differs, nor the data: errors on others do not compare
        spare += [*reversed(keys[DEAR:]), *SPARED[1], *reversed(keys[:DEAR])]
    while spare and _width(columns) > console().width:
        columns = [column for column in columns if column.name != spare[0]]
        del spare[0]
    columns = columns if asked else _with_wide_names(columns)
    width = max(console().width, _width(columns))
    Console(highlight=False, markup=False, width=width).print(_lines(columns))
    return [key for key in keys if key not in {column.name for column in columns}]


def _columns(records: Sequence[Record], keys: Sequence[str], numbers: Mapping[str, str]) -> Iterator[Column]:
    """Yield all columns: values of some keys, and metric columns with short headings.

    `numbers` maps these headings to keys.
    """
    from memmlp.runs.query import data_labels

    yield Column("run", [one["id"] for one in records])
    for key in ("status", "age"):
        if key not in keys:
            yield Column(key, [str(one.get(key) or "-") for one in records])
    labels = data_labels(records)
    if numbers:  # the columns that nobody asked for
        yield Column("name", [_folded(str(one.get("name") or "-"), NAME) for one in records])
        if len(set(labels) - {"-"}) > 1:
            yield Column("data", labels)
    for key in keys:
        values = labels if key == "data" else [value_text(one, key, whole=not numbers) for one in records]
        yield Column(key, [_folded(value) for value in values])
    if any(one.get("tag") for one in records):
        yield Column("tags", ["\n".join(one.get("tag", ())) for one in records])
    for name, key in numbers.items():
        yield Column(name, [shown_number(one, key) for one in records], number=True)


def shown_number(record: Record, key: str) -> str:
    """Return a number as text; a time of another file than the config asks for with that file's name."""
    if key in record:
        return number_text(record[key])
    group, _, name = key.partition(".")
    for other, value in record.items():
        if other.startswith(f"{group}-") and other.partition(".")[2] == name:
            return f"{number_text(value)} {other.partition('.')[0].removeprefix(f'{group}-')}"
    return number_text(None)


def _with_wide_names(columns: Sequence[Column]) -> list[Column]:
    """Return the columns with the names of runs in as few lines as the screen has room for."""
    narrow = _with_names(columns, NAME)
    used = max((len(line) for name in _cells(narrow, "name") for line in name.splitlines()), default=0)
    return _with_names(columns, max(NAME, used + console().width - _width(narrow)))


def _with_names(columns: Sequence[Column], width: int) -> list[Column]:
    """Return the columns with names wrapped to a width; a seed that has its own column is cut from them."""
    names = [name.replace("\n", "") for name in _cells(columns, "name")]
    if names and (seeds := _cells(columns, "seed")):
        names = [name.removesuffix(f" · seed {seed}") for name, seed in zip(names, seeds, strict=True)]
    folded = [_folded(name, width) for name in names]
    return [one._replace(cells=folded) if one.name == "name" else one for one in columns]


def _cells(columns: Sequence[Column], name: str) -> list[str]:
    """Return the cells of the column with a name; empty if there is none."""
    return next((column.cells for column in columns if column.name == name), [])


def _lines(columns: Sequence[Column]) -> Table:
    """Make the table of some columns, whose texts are wrapped already."""
    table = plain_table()
    table.padding, table.show_edge = (0, 0), False
    table.caption_justify, table.caption_style = "left", ""
    table.caption = _legend([column.name for column in columns if column.number])
    for column in columns:
        table.add_column(_folded(column.name), justify="right" if column.number else "left", no_wrap=True)
    for cells in zip(*(column.cells for column in columns), strict=True):
        table.add_row(*cells)
    return table


def _legend(names: Sequence[str]) -> str | None:
    """Return an explanation of the numbers in some columns; None if there are none."""
    words = [said for head, said in LEGEND.items() if any(name.startswith(head) for name in names)]
    return "; ".join(words) or None


def _width(columns: Sequence[Column]) -> int:
    """Return the width of the table of some columns."""
    console = Console(width=10_000)
    return console.measure(_lines(columns)).maximum


def _folded(text: str, width: int = FOLD) -> str:
    """Break a text into lines of up to `width` characters, between words of a key and items of a list."""
    lines = [""]
    for part in re.findall(r"[^.,_/ ]*[.,_/ ]*", text):
        if lines[-1] and len(lines[-1]) + len(part.rstrip()) > width:
            lines.append("")
        lines[-1] += part
    return "\n".join(lines)
