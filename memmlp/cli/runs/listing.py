"""`memmlp runs list`."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click
from rich.cells import cell_len
from rich.table import Table

from memmlp.cli.options import outputs_option
from memmlp.cli.runs.show import (
    ID_LENGTH,
    format_age,
    format_value,
    list_outdated_results,
    make_plain_table,
    read_record,
)
from memmlp.common.text_formats import make_console
from memmlp.evaluation.metric_facts import UNITS
from memmlp.runs import lookup
from memmlp.runs.identity import NETWORK
from memmlp.runs.lookup import count_training_frames, describe_kind, warn_if_hardly_trained
from memmlp.runs.query import Record, check_key, label_data, list_differing_keys, parse_query
from memmlp.runs.run import Run

MAX_RUNS = 20
RESULT_COLUMNS = {
    # column header -> key of the number
    "MPJPE\nstream": "stream.rotation.MPJPE",
    "MPJPE\nwindow": "window.rotation.MPJPE",
    "Jitter\nstream": "stream.rotation.Jitter",
    "ms": "latency.median_ms",
}
LEGEND = (
    f"MPJPE [{UNITS['MPJPE']}], Jitter [{UNITS['Jitter']}]: rotation branch; ms: time per frame on one core"
)
REMOVABLE_COLUMNS = ("ms", "age", "Jitter\nstream", "MPJPE\nwindow")  # in this order on a narrow screen
MAX_COLUMNS = 4  # maximum number of columns for differing keys, without --columns
MAX_NAMED_KEYS = 4  # maximum number of keys without a column to print below the table
NAME_WIDTH = 31  # minimum width of the column of names, in characters


@click.command("list")
@click.option(
    "--all",
    "every",
    is_flag=True,
    help=f"List all runs: more than {MAX_RUNS}, including VQ-VAEs and network parts.",
)
@click.option("--where", help="Condition for runs to list, such as 'memory=gru and stream.MPJPE<6.3'.")
@click.option("--sort", help="Key to sort by, such as stream.MPJPE; -KEY sorts in descending order.")
@click.option("--columns", help="Comma-separated keys to show.  [default: differing config keys]")
@outputs_option
def list_runs(every: bool, where: str | None, sort: str | None, columns: str | None, outputs: Path) -> None:
    """List the runs, newest first. Without --all, finished VQ-VAEs, network parts and archived
    runs are hidden.

    The columns are name, data, differing config keys, the rotation branch's MPJPE in both modes, Jitter, and
    latency per frame. KEY is a config key (`memory`, `optim.lr`), a result (`stream.MPJPE`,
    `window.position.Jitter`, `latency.median_ms`), or `id`, `kind`, `status`, `name`, `data`, `started`,
    `tag`, `note`.
    """
    query = parse_query(where) if where else None
    runs = [run for run in lookup.list_runs(outputs) if every or query or not lookup.read_notes(run).archived]
    if not runs:
        hint = "memmlp demo creates one; --outputs FOLDER or MEMMLP_OUTPUTS selects another folder"
        click.echo(f"no runs in {outputs.absolute() / 'runs'}: {hint}")
        return
    chosen = runs if every or query else [run for run in runs if not _is_finished_part(run)]
    records = _read_records(chosen, len(chosen) if every or query or sort else MAX_RUNS)
    newest = [run for run in chosen if run.id in records]
    fits = query.match_records(list(records.values())) if query else [True] * len(records)
    listed = [run for run, fit in zip(newest, fits, strict=True) if fit]
    if sort:
        listed = _sort_runs(listed, records, sort)
    keys = _choose_keys(columns, records, listed)
    rows = [{**records[run.id], "age": format_age(run)} for run in listed]
    hidden = _print_table(rows, keys, keys_requested=columns is not None)
    sound = [run for run in listed if records[run.id]["status"] != "damaged"]
    for line in (*_describe_outdated_results(sound), *_describe_hardly_trained(sound)):
        click.echo(line)
    if hidden:
        more = f" and {len(hidden) - MAX_NAMED_KEYS} more keys" if len(hidden) > MAX_NAMED_KEYS else ""
        option = ",".join(["name", *hidden[:MAX_NAMED_KEYS], "stream.MPJPE"])
        click.echo(f"they also differ in {', '.join(hidden[:MAX_NAMED_KEYS])}{more}: --columns {option}")
    if parts := Counter(describe_kind(run.manifest["kind"]) for run in runs if run not in chosen):
        counts = ", ".join(f"{count} finished {word}" for word, count in parts.items())
        click.echo(f"{counts}: memmlp runs list --all")
    if len(chosen) > len(newest):
        click.echo(f"{len(chosen) - len(newest)} older runs: memmlp runs list --all")
    elif query:
        click.echo(f"{len(listed)} of {len(chosen)} runs")


def _read_records(runs: Sequence[Run], most: int) -> dict[str, Record]:
    """Read the records of runs in order; stop after `most` undamaged ones."""
    records: dict[str, Record] = {}
    for run in runs:
        if sum(one["status"] != "damaged" for one in records.values()) == most:
            break
        records[run.id] = read_record(run)
    return records


def _describe_outdated_results(listed: Sequence[Run]) -> list[str]:
    ids_by_change: dict[tuple[str, str], list[str]] = {}
    for run in listed:
        for results in list_outdated_results(run).items():
            ids_by_change.setdefault(results, []).append(run.id[:ID_LENGTH])
    return [
        f"{results} {by}; measure again with memmlp eval RUN: {_join_ids(ids)}"
        for (results, by), ids in ids_by_change.items()
    ]


def _describe_hardly_trained(listed: Sequence[Run]) -> list[str]:
    networks = [run for run in listed if run.manifest.get("kind") == NETWORK and run.done]
    ids = [run.id[:ID_LENGTH] for run in networks if warn_if_hardly_trained(count_training_frames(run))]
    if not ids:
        return []
    names = "all finished runs" if len(ids) == len(networks) > 1 else _join_ids(ids)
    return [f"hardly trained, ignore the errors: {names}"]


def _join_ids(ids: Sequence[str]) -> str:
    more = f" and {len(ids) - MAX_RUNS} more" if len(ids) > MAX_RUNS else ""
    return ", ".join(ids[:MAX_RUNS]) + more


def _is_finished_part(run: Run) -> bool:
    return run.kind not in (None, NETWORK) and run.done


def _sort_runs(listed: Sequence[Run], records: Mapping[str, Record], sort: str) -> list[Run]:
    """Return the runs sorted by a key. Runs with a missing or NaN value come last."""
    key, reverse = sort.removeprefix("-"), sort.startswith("-")
    check_key(key, records.values(), "--sort")
    values: dict[str, Any] = {run.id: records[run.id].get(key) for run in listed}
    with_value = [run for run in listed if values[run.id] not in (None, "", ())]
    with_value = [run for run in with_value if values[run.id] == values[run.id]]  # NaN differs from itself
    numbers = all(isinstance(values[run.id], int | float) for run in with_value)
    with_value.sort(key=lambda run: values[run.id] if numbers else str(values[run.id]), reverse=reverse)
    return [*with_value, *(run for run in listed if run not in with_value)]


def _choose_keys(columns: str | None, records: Mapping[str, Record], listed: Sequence[Run]) -> list[str]:
    """Return the keys of --columns, or config keys that differ between finished runs."""
    if columns is not None:
        keys = [key.strip() for key in columns.split(",") if key.strip()]
        for key in keys:
            check_key(key, records.values(), "--columns")
        return keys
    networks = [run for run in listed if records[run.id].get("kind") == NETWORK]
    data = [str(records[run.id].get("data_digest")) for run in networks]
    return list_differing_keys([run.config for run in networks], data) if len(networks) > 1 else []


def _print_table(records: Sequence[Record], keys: Sequence[str], keys_requested: bool) -> list[str]:
    """Print the runs as a table, and return the keys that did not fit. With --columns, all keys are shown."""
    columns = _make_columns(records, keys, keys_requested)
    removable = ["age"] if keys_requested else [*REMOVABLE_COLUMNS, *reversed(keys[:MAX_COLUMNS])]
    limit = make_console().width
    while (width := _find_minimum_width(columns, keys_requested)) > limit and removable:
        columns.pop(removable.pop(0), None)
    make_console(width=max(limit, width)).print(_make_table(columns, keys_requested))
    return [key for key in keys if key not in columns]


def _find_minimum_width(columns: Mapping[str, Sequence[str]], keys_requested: bool) -> int:
    """Return the minimum width of a table in characters: that of the widest word in each column."""
    total = len(columns) - 1
    for head, cells in columns.items():
        least = NAME_WIDTH if head == "name" and not keys_requested else 0
        total += max(least, *(cell_len(word) for cell in (head, *cells) for word in cell.split()))
    return total


def _make_columns(
    records: Sequence[Record], keys: Sequence[str], keys_requested: bool
) -> dict[str, list[str]]:
    columns = {"run": [one["id"] for one in records]}
    columns |= {head: [str(one.get(head) or "-") for one in records] for head in ("status", "age")}
    labels = label_data(records)
    if not keys_requested:
        columns["name"] = [str(one.get("name") or "-") for one in records]
        if len(set(labels) - {"-"}) > 1:
            columns["data"] = labels
    for key in keys if keys_requested else keys[:MAX_COLUMNS]:
        values = [format_value(one, key, whole=keys_requested) for one in records]
        columns[key] = labels if key == "data" else values
    if any(one.get("tag") for one in records):
        columns["tags"] = ["\n".join(one.get("tag", ())) for one in records]
    if not keys_requested:
        columns |= {
            head: [format_number(one, key) for one in records] for head, key in RESULT_COLUMNS.items()
        }
    return columns


def _make_table(columns: Mapping[str, Sequence[str]], keys_requested: bool) -> Table:
    table = make_plain_table()
    table.padding, table.show_edge = (0, 0), False
    table.caption_justify, table.caption_style = "left", ""
    table.caption = None if keys_requested else LEGEND
    for head in columns:
        is_name = head == "name" and not keys_requested
        is_number = head in RESULT_COLUMNS and not keys_requested
        table.add_column(
            head,
            justify="right" if is_number else "left",
            no_wrap=not is_name,
            min_width=NAME_WIDTH if is_name else None,
            overflow="fold",
        )
    for cells in zip(*columns.values(), strict=True):
        table.add_row(*cells)
    return table


def format_number(record: Record, key: str) -> str:
    """Format a number; a time also names the measured file if it is not the file that the config requests."""
    group, _, name = key.partition(".")
    others = (other for other in record if other.startswith(f"{group}-") and other.partition(".")[2] == name)
    shown = key if key in record else next(others, None)
    value = record[shown] if shown else None
    if shown is None or not isinstance(value, int | float):
        return "-"
    file = shown.partition(".")[0].removeprefix(group).removeprefix("-")
    return f"{value:.2f} {file}".rstrip()
