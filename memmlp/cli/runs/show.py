"""`memmlp runs show` and `memmlp runs diff`, and helpers for the other commands of `memmlp runs`."""

import re
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click
from rich import box
from rich.table import Table

from memmlp.cli.options import outputs_option
from memmlp.common.errors import InputError
from memmlp.common.overrides import flatten
from memmlp.common.text_formats import make_console
from memmlp.evaluation.metric_facts import UNITS
from memmlp.runs.deployment_folder import describe_timing_machine
from memmlp.runs.evaluation_file import add_solver_names
from memmlp.runs.lookup import count_training_frames, find_run, is_trained, warn_if_hardly_trained
from memmlp.runs.query import Record, build_record, format_typed_value, label_data, list_differing_keys
from memmlp.runs.run import Run

ID_LENGTH = 8  # number of characters of a shortened id
MAX_VALUE_LENGTH = 36  # maximum number of characters of a value
SUMMARY_KEYS = ("kind", "started", "finished")
HIDDEN_KEYS = (
    "id", "name", "data", "prerequisite", "prerequisite_runs", "sources",
    "source_bytes", "attempts", "forgiven", "stages", *SUMMARY_KEYS,
)  # fmt: skip
ORIGIN_KEYS = (
    "device", "gpu", "threads", "processes", "precision", "version", "git", "python", "packages",
    "component_versions",
)  # fmt: skip


@click.command("show")
@click.argument("run")
@click.option("--config", "config", is_flag=True, help="Also print the run's resolved config.")
@outputs_option
def show(run: str, config: bool, outputs: Path) -> None:
    """Show one run and its results.

    RUN is an id, the beginning of an id, a folder, or a shipped network.
    """
    from memmlp.report.tables.measured_run import load_measured_run

    found = find_run(outputs, run)
    make_console().print(_make_pair_table(_summarize_run(found)))
    if is_trained(found):
        for source, measured in load_measured_run(found.folder).split_by_source().items():
            means = add_solver_names(measured.means, found.configured_evaluations.combined_solvers)
            make_console().print(_make_pair_table(flatten(means), title=f"results on {source}"))
    if found.results:
        make_console().print(_make_pair_table(collect_measured_numbers(found), title="results"))
    origin = {key: value for key, value in found.manifest.items() if key not in HIDDEN_KEYS}
    components = {"component_versions": origin.pop("component_versions", {})}
    make_console().print(_make_pair_table(flatten(origin | components), title="made by"))
    if config and found.config:
        make_console().print(_make_pair_table(flatten(found.config), title="config"))


def _summarize_run(run: Run) -> dict[str, Any]:
    values, manifest = read_record(run), run.manifest
    facts = {"run": run.id, "name": values.get("name"), "folder": run.folder, "status": run.status}
    if failure := run.failure:
        facts["failed with"] = failure
    facts |= {key: manifest[key] for key in SUMMARY_KEYS if key in manifest}
    digest = str(values.get("data_digest", ""))[:ID_LENGTH]
    facts["data"] = " ".join(dict.fromkeys([str(values.get("data", "-")), digest]))
    if prerequisite := manifest.get("prerequisite"):
        facts["needs run"] = prerequisite
    if attempts := manifest.get("attempts"):
        lines = (f"{one.get('stage')} from step {one.get('step')}, {one.get('started')}" for one in attempts)
        facts["attempts"] = "\n".join(lines)
    facts |= list_outdated_results(run)
    if changed := run.verify():
        facts["changed since"] = ", ".join(changed)
    return facts


@click.command("diff")
@click.argument("a")
@click.argument("b")
@outputs_option
def diff(a: str, b: str, outputs: Path) -> None:
    """Show how two runs differ.

    The command compares config keys that affect results, data, results, code and machine. Changes are B
    minus A.
    """
    pair = first, second = find_run(outputs, a), find_run(outputs, b)
    ids, short = [run.id for run in pair], [run.id[:ID_LENGTH] for run in pair]
    if rows := _list_config_differences(first, second):
        _print_rows(make_plain_table("config", *ids), rows, wrapped=slice(1, None))
    else:
        click.echo("config: no difference")
    if rows := list_result_differences(first, second):
        _print_rows(make_plain_table("results", *short, "change", "unit"), rows, wrapped=slice(1))
        click.echo("such changes can be chance; memmlp sweep compares several seeds")
    else:
        click.echo("results: no difference")
    for run in pair:
        if remark := warn_if_hardly_trained(count_training_frames(run)):
            click.echo(f"run {run.id[:ID_LENGTH]}: {remark}")
    data = [run.manifest.get("data") for run in pair]
    if all(data) and data[0] != data[1]:
        click.echo("the runs' data differ, so their errors are for different test clips")
    if rows := _list_origin_differences(first, second):
        _print_rows(make_plain_table("made by", *ids), rows, wrapped=slice(None))


def _print_rows(table: Table, rows: list[tuple[str, ...]], wrapped: slice) -> None:
    """Print a table in which only the columns of the slice `wrapped` can wrap, because numbers must not."""
    for column in table.columns:
        column.no_wrap = column not in table.columns[wrapped]
    for row in rows:
        table.add_row(*row)
    make_console().print(table)


def _list_config_differences(first: Run, second: Run) -> list[tuple[str, ...]]:
    pair = [read_record(run) for run in (first, second)]
    digests = [str(one.get("data_digest")) for one in pair]
    keys = list_differing_keys([first.config, second.config], digests)
    rows = [(key, *(format_value(one, key) for one in pair)) for key in keys]
    return rows if len(set(digests)) == 1 else [("data", *label_data(pair)), *rows]


def list_result_differences(first: Run, second: Run) -> list[tuple[str, ...]]:
    a, b = collect_measured_numbers(first), collect_measured_numbers(second)
    return [
        (
            key,
            _format_cell(a.get(key)),
            _format_cell(b.get(key)),
            f"{b[key] - a[key]:+.4g}" if key in a and key in b else "-",
            UNITS.get(key.rpartition(".")[2], "ms" if key.endswith("_ms") else ""),
        )
        for key in a | b
        if a.get(key) != b.get(key)
    ]


def _list_origin_differences(first: Run, second: Run) -> list[tuple[str, ...]]:
    a, b = (
        flatten({key: run.manifest.get(key) for key in ORIGIN_KEYS})
        | {"latency": describe_timing_machine(run.find_shown_deployment(run.config).record)}
        | list_outdated_results(run)
        for run in (first, second)
    )
    return [
        (key, _format_cell(a.get(key)), _format_cell(b.get(key)))
        for key in a | b
        if a.get(key) != b.get(key) and (not key.startswith("component_versions.") or (key in a and key in b))
    ]


def read_record(run: Run) -> Record:
    """Return a run's record of values. For a run with a damaged file, it has only the id and status."""
    try:
        return build_record(run)
    except InputError as error:
        click.echo(f"memmlp: warning: {error}", err=True)
        return {"id": run.id, "status": "damaged"}


def format_value(record: Record, key: str, whole: bool = False) -> str:
    """Format a record's value; a long text is shortened unless `whole` is set."""
    text = format_typed_value(record[key]) if key in record else "-"
    return text if whole or len(text) <= MAX_VALUE_LENGTH else f"{text[:MAX_VALUE_LENGTH]}…"


def collect_measured_numbers(run: Run) -> dict[str, Any]:
    """Return the numbers in a run's results by dotted key; the keys include the inverse kinematics' name."""
    return {
        key: value
        for key, value in run.flat_results.items()
        if isinstance(value, int | float) and not re.match(r"latency[^.]*\.(settings|made)", key)
    }


def list_outdated_results(run: Run) -> dict[str, str]:
    """Return the results that earlier component versions measured; an empty dict for a damaged run."""
    try:
        outdated = run.configured_evaluations.outdated
    except InputError:  # `read_record` reports it
        return {}
    return {f"{mode} results": f"by an earlier version: {changes}" for mode, changes in outdated.items()}


def make_plain_table(*columns: str, title: str | None = None) -> Table:
    """Make a table without a border. Long values are wrapped, not cut."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, title=title, title_justify="left")
    for column in columns:
        table.add_column(column, overflow="fold")
    return table


def _make_pair_table(facts: Mapping[str, Any], title: str | None = None) -> Table:
    table = make_plain_table("", "", title=title)
    table.show_header = False
    for key, value in facts.items():
        table.add_row(key, _format_cell(value))
    return table


def _format_cell(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    return "-" if value is None else str(value)


def format_age(run: Run) -> str:
    try:
        started = datetime.fromisoformat(run.manifest.get("started", ""))
        seconds = (datetime.now(UTC) - started).total_seconds()
    except (TypeError, ValueError):
        return "-"
    for unit, size in (("d", 86400), ("h", 3600), ("min", 60)):
        if seconds >= size:
            return f"{int(seconds // size)} {unit}"
    return f"{int(max(seconds, 0))} s"
