"""`memmlp runs show` and `memmlp runs diff`, and what the commands of runs share."""

from __future__ import annotations

import re
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich import box
from rich.console import Console
from rich.table import Table

from memmlp.cli.options import outputs_option
from memmlp.common.errors import InputError
from memmlp.evaluation.metric_facts import UNITS

if TYPE_CHECKING:
    from memmlp.runs.query import Record
    from memmlp.runs.run import Run

SHORT = 8  # characters of a shortened id
MAX_LENGTH = 36  # characters of a shortened value
SUMMARY = ("kind", "started", "finished")
HIDDEN = (
    "id", "name", "data", "prerequisite", "prerequisite_runs", "sources",
    "source_bytes", "attempts", "forgiven", "stages", *SUMMARY,
)  # fmt: skip
ORIGIN = (
    "device", "gpu", "threads", "processes", "precision", "version", "git", "python", "packages",
    "component_versions",
)  # fmt: skip


@click.command("show")
@click.argument("run")
@click.option("--config", "config", is_flag=True, help="Print the run's resolved config, too.")
@outputs_option
def show(run: str, config: bool, outputs: Path) -> None:
    """Show one run and its results.

    RUN is its id, the beginning of it, or its folder.
    """
    from memmlp.report.tables.measured_run import load_measured_run
    from memmlp.runs.evaluation_file import name_solvers
    from memmlp.runs.identity import flatten
    from memmlp.runs.lookup import find_run, is_trained

    found = find_run(outputs, run)
    console().print(_pairs(_summary(found)))
    if is_trained(found):
        for source, measured in load_measured_run(found.folder).split_by_source().items():
            means = name_solvers(measured.means, found.evaluations_as_configured.combined_solvers)
            console().print(_pairs(flatten(means), title=f"results on {source}"))
    if found.results:
        console().print(_pairs(measured_numbers(found), title="results"))
    origin = {key: value for key, value in found.manifest.items() if key not in HIDDEN}
    components = {"component_versions": origin.pop("component_versions", {})}
    console().print(_pairs(flatten(origin | components), title="made by"))
    if config and found.config:
        console().print(_pairs(flatten(found.config), title="config"))


def _summary(run: Run) -> dict[str, Any]:
    """Return what a run is, and its progress."""
    values, manifest = record_of(run), run.manifest
    facts = {"run": run.id, "name": values.get("name"), "folder": run.folder, "status": run.status}
    if failure := run.failure:
        facts["failed with"] = failure
    facts |= {key: manifest[key] for key in SUMMARY if key in manifest}
    digest = str(values.get("data_digest", ""))[:SHORT]
    facts["data"] = " ".join(dict.fromkeys([str(values.get("data", "-")), digest]))
    if prerequisite := manifest.get("prerequisite"):
        facts["needs run"] = prerequisite
    attempts = [
        f"{one['stage']} from step {one['step']}, {one['started']}"
        for one in manifest.get("attempts", [])
        if {"stage", "step", "started"} <= one.keys()
    ]
    if attempts:
        facts["attempts"] = "\n".join(attempts)
    facts |= outdated_results(run)
    if changed := run.verify():
        facts["changed since"] = ", ".join(changed)
    return facts


@click.command("diff")
@click.argument("a")
@click.argument("b")
@outputs_option
def diff(a: str, b: str, outputs: Path) -> None:
    """Show how two runs differ.

    Compared are the config keys that affect results, the data, the results, and code and machine. The change
    is B minus A.
    """
    from memmlp.runs.lookup import count_training_frames, find_run, warn_if_hardly_trained

    pair = first, second = find_run(outputs, a), find_run(outputs, b)
    ids, short = [run.id for run in pair], [run.id[:SHORT] for run in pair]
    if rows := _config_differences(first, second):
        _print_rows(plain_table("config", *ids), rows, wrapped=slice(1, None))
    else:
        click.echo("config: no difference")
    if rows := result_differences(first, second):
        _print_rows(plain_table("results", *short, "change", "unit"), rows, wrapped=slice(1))
        click.echo("one run of each: such changes may be chance; memmlp sweep compares over seeds")
    else:
        click.echo("results: no difference")
    for run in pair:
        if remark := warn_if_hardly_trained(count_training_frames(run)):
            click.echo(f"run {run.id[:SHORT]}: {remark}")
    data = [run.manifest.get("data") for run in pair]
    if all(data) and data[0] != data[1]:
        click.echo("their data differ, so their errors are on different test clips")
    if rows := _origin_differences(first, second):
        _print_rows(plain_table("made by", *ids), rows, wrapped=slice(None))


def _print_rows(table: Table, rows: list[tuple[str, ...]], wrapped: slice) -> None:
    """Print a table in which only some columns may be wrapped: a number in two lines is misread."""
    for column in table.columns:
        column.no_wrap = column not in table.columns[wrapped]
    for row in rows:
        table.add_row(*row)
    console().print(table)


def _config_differences(first: Run, second: Run) -> list[tuple[str, ...]]:
    """Return a row for each differing key of the config, or the data, that changes a result."""
    from memmlp.runs.query import label_data, list_differing_keys

    pair = [record_of(run) for run in (first, second)]
    digests = [str(one.get("data_digest")) for one in pair]
    keys = list_differing_keys([run.config for run in (first, second)], digests)
    rows = [(key, *(value_text(one, key) for one in pair)) for key in keys]
    return rows if len(set(digests)) == 1 else [("data", *label_data(pair)), *rows]


def result_differences(first: Run, second: Run) -> list[tuple[str, ...]]:
    """Return a row for each measured number that differs: its key, both values, the change, and its unit."""
    a, b = measured_numbers(first), measured_numbers(second)
    return [
        (
            key,
            _text(a.get(key)),
            _text(b.get(key)),
            f"{b[key] - a[key]:+.4g}" if key in a and key in b else "-",
            UNITS.get(key.rpartition(".")[2], "ms" if key.endswith("_ms") else ""),
        )
        for key in a | b
        if a.get(key) != b.get(key)
    ]


def _origin_differences(first: Run, second: Run) -> list[tuple[str, ...]]:
    """Return a row for every difference in code and machine that may change numbers despite equal configs."""
    from memmlp.runs.deployment_folder import describe_timing_machine
    from memmlp.runs.identity import flatten

    a, b = (
        flatten({key: run.manifest.get(key) for key in ORIGIN})
        | {"latency": describe_timing_machine(run.deployment_as_configured.record), **outdated_results(run)}
        for run in (first, second)
    )
    return [
        (key, _text(a.get(key)), _text(b.get(key)))
        for key in a | b
        if a.get(key) != b.get(key) and (not key.startswith("component_versions.") or (key in a and key in b))
    ]


def record_of(run: Run) -> Record:
    """Return a run's record of values; of a run with a damaged file, only its id and status."""
    from memmlp.runs.query import build_record

    try:
        return build_record(run)
    except InputError as error:
        click.echo(f"memmlp: warning: {error}", err=True)
        return {"id": run.id, "status": "damaged"}


def value_text(record: Record, key: str, whole: bool = False) -> str:
    """Return a record's value as text; a long one is shortened unless the whole is wanted."""
    from memmlp.runs.query import format_typed_value

    text = format_typed_value(record[key]) if key in record else "-"
    return text if whole or len(text) <= MAX_LENGTH else f"{text[:MAX_LENGTH]}…"


def measured_numbers(run: Run) -> dict[str, Any]:
    """Return the numbers in a run's results by dotted key, with the names of inverse kinematics in these."""
    from memmlp.runs.deployment_folder import replace_with_deployed_times
    from memmlp.runs.evaluation_file import name_solvers
    from memmlp.runs.identity import flatten

    results = name_solvers(run.results, run.evaluations_as_configured.combined_solvers)
    return {
        key: value
        for key, value in flatten(replace_with_deployed_times(results)).items()
        if isinstance(value, int | float) and not re.match(r"latency[^.]*\.(settings|made)", key)
    }


def outdated_results(run: Run) -> dict[str, str]:
    """Return which of a run's results were measured by earlier component versions; none for a damaged run."""
    try:
        outdated = run.evaluations_as_configured.outdated
    except InputError:  # `record_of` reports it
        return {}
    return {f"{mode} results": f"by an earlier version: {changes}" for mode, changes in outdated.items()}


def console() -> Console:
    """Make a console that prints texts unchanged."""
    return Console(highlight=False, markup=False)


def plain_table(*columns: str, title: str | None = None) -> Table:
    """Make a table without a border; long values are wrapped, and no word is cut."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, title=title, title_justify="left")
    for column in columns:
        table.add_column(column, overflow="fold")
    return table


def _pairs(facts: Mapping[str, Any], title: str | None = None) -> Table:
    """Make a table of keys and values."""
    table = plain_table("", "", title=title)
    table.show_header = False
    for key, value in facts.items():
        table.add_row(key, _text(value))
    return table


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return "-" if value is None else str(value)


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
