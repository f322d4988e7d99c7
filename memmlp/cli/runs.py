"""`memmlp runs`: list, show, compare, tag, clean up and move run folders."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import click
from rich import box
from rich.console import Console
from rich.table import Table

from memmlp.cli.options import PATH, Finite, outputs_option
from memmlp.common.errors import InputError
from memmlp.evaluation.units import UNITS

if TYPE_CHECKING:
    from memmlp.runs.garbage import Garbage
    from memmlp.runs.query import Record
    from memmlp.runs.run import Run

NEWEST = 20
SHOWN = {
    # the column's head -> the key of its number
    "MPJPE\nstream": "stream.rotation.MPJPE",
    "MPJPE\nwindow": "window.rotation.MPJPE",
    "Jitter": "stream.rotation.Jitter",
    "ms": "latency.median_ms",
}
LEGEND = f"MPJPE [{UNITS['MPJPE']}], Jitter [{UNITS['Jitter']}]: rotation branch. ms: a frame on one core."
SPARED = ("ms", "age", "Jitter", "MPJPE\nwindow")  # what a narrow screen has no room for, first
FOLD = 12  # characters of a value in a line, where it can be broken
NAME = 36  # characters of a run's name in a line
LONGEST = 3 * FOLD  # characters of a value that nobody asked for


@click.group("runs")
def runs() -> None:
    """List, show, compare, tag, clean up and move runs."""


@runs.command("list")
@click.option("--all", "every", is_flag=True, help=f"List all: VQ-VAEs too, and more than {NEWEST}.")
@click.option(
    "--where", help="List the runs that fulfil a condition, such as 'memory=gru and stream.MPJPE<6.3'."
)
@click.option("--sort", help="Sort by a key, such as stream.MPJPE; -KEY begins with the largest.")
@click.option("--columns", help="Show these keys, separated by commas.  [default: config keys that differ]")
@outputs_option
def list_command(
    every: bool, where: str | None, sort: str | None, columns: str | None, outputs: Path
) -> None:
    """List the runs, the newest first, without the finished ones of VQ-VAEs.

    Shown are their names and data, what differs between their configs, the MPJPE of the rotation branch in
    both modes, Jitter, and the latency of a frame. Keys are those of the config (`memory`, `optim.lr`),
    results (`stream.MPJPE`, `window.position.Jitter`, `latency.median_ms`), and `id`, `kind`, `status`,
    `name`, `data`, `started`, `tag`, `note`.
    """
    from memmlp.runs.lookup import list_runs
    from memmlp.runs.query import parse

    query = parse(where) if where else None
    there = list_runs(outputs)
    if not there:
        click.echo(f"no runs in {outputs / 'runs'}; memmlp demo makes the first")
        return
    found = there if every or query else [run for run in there if not is_finished_vqvae(run)]
    limit = len(found) if every or query or sort else NEWEST
    records = {run.id: recorded(run) for run in found[:limit]}
    fits = query.of(list(records.values())) if query else [True] * len(records)
    listed = [run for run, fit in zip(found[:limit], fits, strict=True) if fit]
    if sort:
        listed = sorted_by(listed, records, sort)
    keys = wanted(columns, records, listed)
    hidden = show_runs([{**records[run.id], "age": _age(run)} for run in listed], keys, bool(columns))
    if hidden:
        click.echo(f"they differ in {', '.join(hidden)}, too: --columns shows it")
    if vqvaes := len(there) - len(found):
        click.echo(f"{vqvaes} finished VQ-VAE{'s' if vqvaes > 1 else ''}: memmlp runs list --all")
    if len(found) > limit:
        click.echo(f"{len(found) - limit} older ones: memmlp runs list --all")
    elif query:
        click.echo(f"{len(listed)} of {len(found)} runs")


def is_finished_vqvae(run: Run) -> bool:
    """Whether it is a finished run of a VQ-VAE, which has none of the results that are listed."""
    return run.manifest.get("kind") == "vqvae" and run.done


def recorded(run: Run) -> Record:
    """Return what may be asked of a run; of one with a damaged file, its id and status alone."""
    from memmlp.runs.query import record

    try:
        return record(run)
    except InputError as error:
        click.echo(f"memmlp: warning: {error}", err=True)
        return {"id": run.id, "status": "damaged"}


def sorted_by(listed: Sequence[Run], records: Mapping[str, Record], sort: str) -> list[Run]:
    """Return the runs sorted by a key; those that have no such value come last."""
    from memmlp.runs.query import check_key

    key, down = sort.removeprefix("-"), sort.startswith("-")
    check_key(key, records.values(), "--sort")
    known = [run for run in listed if records[run.id].get(key) not in (None, "", ())]
    values = [records[run.id][key] for run in known]
    numbers = all(isinstance(value, int | float) for value in values)
    ranked = sorted(
        known, key=lambda run: records[run.id][key] if numbers else str(records[run.id][key]), reverse=down
    )
    return [*ranked, *(run for run in listed if run not in known)]


def wanted(columns: str | None, records: Mapping[str, Record], listed: Sequence[Run]) -> list[str]:
    """Return the keys to show: those asked for, or those of the config that differ among finished runs."""
    from memmlp.runs.query import check_key, differing

    if columns is not None:
        keys = [key.strip() for key in columns.split(",") if key.strip()]
        for key in keys:
            check_key(key, records.values(), "--columns")
        return keys
    networks = [run for run in listed if records[run.id].get("kind") == "memmlp"]
    data = [str(records[run.id].get("data_digest")) for run in networks]
    return differing([run.config for run in networks], data) if len(networks) > 1 else []


class Column(NamedTuple):
    """A column of the list.

    Attributes:
        name: its head, or the key that it shows.
        cells: its text for each run.
        number: whether these are numbers.
    """

    name: str
    cells: list[str]
    number: bool = False


def show_runs(records: Sequence[Record], keys: Sequence[str], asked: bool) -> list[str]:
    """Print the runs as a table, and return the keys for which there was no room.

    Args:
        records: what may be asked of each run, and its `age`.
        keys: the keys whose values are shown.
        asked: whether these were asked for, so that they are shown whatever room there is, without results.
    """
    columns = list(_columns(records, keys, {} if asked else SHOWN))
    spare = [name for name in SPARED if name not in keys]
    spare += [] if asked else [*reversed(keys[1:]), "name"]
    while spare and _width(columns) > _console().width:
        columns = [column for column in columns if column.name != spare[0]]
        del spare[0]
    width = max(_console().width, _width(columns))
    Console(highlight=False, markup=False, width=width).print(_lines(columns))
    return [key for key in keys if key not in {column.name for column in columns}]


def _columns(records: Sequence[Record], keys: Sequence[str], numbers: Mapping[str, str]) -> Iterator[Column]:
    """Yield all columns, with the values of some keys, and with some numbers under heads of ours."""
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
        values = labels if key == "data" else [_value(one, key, whole=not numbers) for one in records]
        yield Column(key, [_folded(value) for value in values])
    if any(one.get("tag") for one in records):
        yield Column("tags", ["\n".join(one.get("tag", ())) for one in records])
    for name, key in numbers.items():
        yield Column(name, [_cell(one.get(key)) for one in records], number=True)


def _value(record: Record, key: str, whole: bool) -> str:
    """Return a record's value as text, of a long one its beginning unless the whole is wanted."""
    from memmlp.runs.query import shown

    text = shown(record[key]) if key in record else "-"
    return text if whole or len(text) <= LONGEST else f"{text[:LONGEST]}…"


def _lines(columns: Sequence[Column]) -> Table:
    """Make the table of some columns, whose texts are folded already."""
    table = _table()
    table.padding, table.show_edge = (0, 0), False
    table.caption_justify, table.caption_style = "left", ""
    table.caption = LEGEND if any(column.number for column in columns) else None
    for column in columns:
        table.add_column(_folded(column.name), justify="right" if column.number else "left", no_wrap=True)
    for cells in zip(*(column.cells for column in columns), strict=True):
        table.add_row(*cells)
    return table


def _width(columns: Sequence[Column]) -> int:
    """Return how wide the table of some columns is."""
    console = Console(width=10_000)
    return console.measure(_lines(columns)).maximum


def _folded(text: str, width: int = FOLD) -> str:
    """Break a text into lines of some characters, between the words of a key and the items of a list."""
    lines = [""]
    for part in re.findall(r"[^.,_/ ]*[.,_/ ]*", text):
        if lines[-1] and len(lines[-1]) + len(part.rstrip()) > width:
            lines.append("")
        lines[-1] += part
    return "\n".join(lines)


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
    _console().print(_pairs(_summary(found)))
    if is_trained(found):
        for source, measured in load(found.folder).by_source().items():
            _console().print(_pairs(flatten(measured.means), title=f"results on {source}"))
    if found.results:
        _console().print(_pairs(measured_numbers(found.results), title="results"))
    _console().print(_pairs(_origin(found), title="made by"))
    if config and found.config:
        _console().print(_pairs(flatten(found.config), title="config"))


SUMMARY = ("kind", "started", "finished")
LEFT_OUT = ("id", "name", "what", "data", "upstream", "sources", "attempts", *SUMMARY)


def _summary(run: Run) -> dict[str, Any]:
    """Return what a run is and how it went, in words."""
    one, manifest = recorded(run), run.manifest
    facts = {"run": run.id, "name": one.get("name"), "folder": run.folder, "status": run.status}
    facts |= {key: manifest[key] for key in SUMMARY if key in manifest}
    facts["data"] = " ".join(dict.fromkeys([str(one.get("data", "-")), str(one.get("data_digest", ""))[:8]]))
    if above := manifest.get("upstream"):
        facts["VQ-VAE" if one.get("kind") == "memmlp" else "builds upon"] = above
    attempts = [f"{one['stage']} from step {one['step']}, {one['started']}" for one in _attempts(manifest)]
    if attempts:
        facts["worked on"] = "\n".join(attempts)
    if changed := run.verify():
        facts["changed since"] = ", ".join(changed)
    return facts


def _attempts(manifest: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Return the stages that processes began, of those records that tell all about it."""
    return [one for one in manifest.get("attempts", []) if {"stage", "step", "started"} <= one.keys()]


def _origin(run: Run) -> dict[str, Any]:
    """Return of what code and on which machine a run was made, the numbers of recipes last."""
    from memmlp.runs.identity import flatten

    facts = {key: value for key, value in run.manifest.items() if key not in LEFT_OUT}
    recipes = facts.pop("recipes", {})
    return flatten(facts | {"recipes": recipes})


def measured_numbers(results: Mapping[str, Any]) -> dict[str, Any]:
    """Return the numbers among results by dotted key, which may hold settings and digests, too."""
    from memmlp.runs.identity import flatten

    numbers = {key: value for key, value in flatten(results).items() if isinstance(value, int | float)}
    return {
        key: value
        for key, value in numbers.items()
        if not key.startswith(("latency.settings", "latency.made"))
    }


@runs.command("diff")
@click.argument("a")
@click.argument("b")
@outputs_option
def diff_command(a: str, b: str, outputs: Path) -> None:
    """Show in what two runs differ.

    Compared are the keys of their configs that change a result, their data, what was measured, and code and
    machine. The difference is how much more B has than A.
    """
    from memmlp.runs.lookup import find_run

    first, second = find_run(outputs, a), find_run(outputs, b)
    for title, rows in (("config", config_rows(first, second)), ("results", result_rows(first, second))):
        if not rows:
            click.echo(f"{title}: no difference")
            continue
        table = _table(title, first.id, second.id, *(["B - A", "unit"] if title == "results" else []))
        table.columns[0].no_wrap = True
        for row in rows:
            table.add_row(*row)
        _console().print(table)
    if rows := origin_rows(first, second):
        table = _table("made by", first.id, second.id)
        for row in rows:
            table.add_row(*row)
        _console().print(table)


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


def origin_rows(first: Run, second: Run) -> list[tuple[str, ...]]:
    """Return a row for all in code and machine that differs, and may change numbers beside the config."""
    from memmlp.runs.identity import flatten

    a, b = (flatten({key: run.manifest.get(key) for key in ORIGIN}) for run in (first, second))
    used = {key for key in a | b if not key.startswith("recipes.") or (key in a and key in b)}
    return [
        (key, _text(a.get(key)), _text(b.get(key)))
        for key in a | b
        if key in used and a.get(key) != b.get(key)
    ]


def config_rows(first: Run, second: Run) -> list[tuple[str, ...]]:
    """Return a row for each key of the config, or the data, that changes a result and differs."""
    from memmlp.runs.query import data_labels, differing

    pair = [recorded(run) for run in (first, second)]
    digests = [str(one.get("data_digest")) for one in pair]
    keys = differing([run.config for run in (first, second)], digests)
    rows = [(key, *(_value(one, key, whole=False) for one in pair)) for key in keys]
    return rows if len(set(digests)) == 1 else [("data", *data_labels(pair)), *rows]


def result_rows(first: Run, second: Run) -> list[tuple[str, ...]]:
    """Return a row for each measured number that differs: its key, both values, B - A, and its unit."""
    a, b = measured_numbers(first.results), measured_numbers(second.results)
    keys = [key for key in a | b if a.get(key) != b.get(key)]
    return [
        (
            key,
            _text(a.get(key)),
            _text(b.get(key)),
            f"{b[key] - a[key]:+.4g}" if key in a and key in b else "-",
            UNITS.get(key.rpartition(".")[2], "ms" if key.endswith("_ms") else ""),
        )
        for key in keys
    ]


@runs.command("tag")
@click.argument("run")
@click.argument("tags", nargs=-1, required=True)
@click.option("--remove", is_flag=True, help="Take the tags away instead.")
@outputs_option
def tag_command(run: str, tags: tuple[str, ...], remove: bool, outputs: Path) -> None:
    """Give a run tags.

    They lie in its folder, are found by `memmlp runs list --where tag=WORD`, and are no part of what the run
    is. `memmlp runs gc` spares runs with tags.
    """
    from memmlp.runs.lookup import find_run
    from memmlp.runs.notes import add_tags, remove_tags

    found = find_run(outputs, run)
    notes = remove_tags(found, tags) if remove else add_tags(found, tags)
    click.echo(f"{found.id}: {', '.join(notes.tags) or 'no tags'}")


@runs.command("note")
@click.argument("run")
@click.argument("text", required=False)
@outputs_option
def note_command(run: str, text: str | None, outputs: Path) -> None:
    """Replace a run's note by TEXT, or print it.

    An empty TEXT removes it.
    """
    from memmlp.runs.lookup import find_run
    from memmlp.runs.notes import read_notes, set_note

    found = find_run(outputs, run)
    notes = read_notes(found) if text is None else set_note(found, text)
    click.echo(f"{found.id}: {notes.note or 'no note'}")


@runs.command("gc")
@click.option(
    "--only",
    "kinds",
    multiple=True,
    type=click.Choice(["failed", "old", "orphaned"]),
    help="Delete these alone; may be repeated.  [default: all three]",
)
@click.option("--yes", is_flag=True, help="Delete them. Without it they are only shown.")
@outputs_option
def gc_command(kinds: tuple[str, ...], yes: bool, outputs: Path) -> None:
    """Show, or delete, runs that nobody needs.

    These have failed, are of an older recipe, or are orphaned: no longer in a sweep, a VQ-VAE that no run
    uses, a folder in which nothing began. Runs with a tag or a note, runs that are going on, and what other
    runs build upon stay.
    """
    from memmlp.runs.garbage import REASONS, delete, garbage

    found = garbage(outputs, kinds or REASONS)
    if not found:
        click.echo("nothing to delete")
        return
    _console().print(_garbage_table(found))
    if not yes:
        size = sum(one.size for one in found) / 1e6
        click.echo(f"{len(found)} runs, {size:.1f} MB; delete them with --yes")
        return
    gone = [one for one in found if delete(one)]
    click.echo(f"deleted {len(gone)} runs, {sum(one.size for one in gone) / 1e6:.1f} MB")
    for one in found:
        if one not in gone:
            click.echo(f"run {one.run.id} stays: somebody is at it, or gave it a tag or a note", err=True)


def _garbage_table(found: Sequence[Garbage]) -> Table:
    table = _table("run", "why", "reason", "age", "MB")
    for one in found:
        table.add_row(one.run.id, one.kind, one.reason, _age(one.run), f"{one.size / 1e6:.1f}")
    return table


@runs.command("export")
@click.argument("run")
@click.option("--out", type=PATH, help="The file.  [default: RUN.memmlp.zip in this folder]")
@outputs_option
def export_command(run: str, out: Path | None, outputs: Path) -> None:
    """Write a finished run to one file, which another machine can import.

    It has the run's config, record, weights, results, tags and note, and no checkpoint.
    """
    from memmlp.runs.archive import export_run
    from memmlp.runs.lookup import find_run

    found = find_run(outputs, run)
    path = out or Path(f"{found.id}.memmlp.zip")
    digest = export_run(found, path)
    click.echo(f"{path}  {path.stat().st_size / 1e6:.1f} MB")
    click.echo(f"sha256 {digest}")


@runs.command("import")
@click.argument("path", type=PATH)
@click.option("--sha256", help="The digest that `memmlp runs export` printed.  [default: any]")
@click.option("--max-gb", type=Finite(0, min_open=True), default=4.0, show_default=True, help="Size at most.")
@outputs_option
def import_command(path: Path, sha256: str | None, max_gb: float, outputs: Path) -> None:
    """Take a run from a file that `memmlp runs export` wrote.

    It is refused if a digest in it does not hold. With --sha256 it is the very file that was exported.
    """
    from memmlp.runs.archive import import_run

    run, new = import_run(path, outputs, sha256, int(max_gb * 1e9))
    click.echo(f"run {run.id}: {'imported' if new else 'was there already'}")


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


def _cell(value: Any) -> str:
    """Return a number as text; "-" where there is none."""
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
