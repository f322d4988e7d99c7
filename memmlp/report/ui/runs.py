"""The server's answers about runs: rows of the run table, a run's page, and curves."""

import math
import secrets
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

from memmlp.common.errors import InputError
from memmlp.common.files import make_json_safe
from memmlp.common.overrides import flatten
from memmlp.report.tables.measured_run import load_measured_run
from memmlp.report.tables.table_text import find_direction, find_unit
from memmlp.report.ui.run_index import COSTS, RunIndex, list_preparations, read_config
from memmlp.runs import records
from memmlp.runs.deployment_folder import select_deployed_measurements
from memmlp.runs.evaluation_file import add_solver_names
from memmlp.runs.identity import NEUTRAL, is_data_path
from memmlp.runs.lookup import is_trained
from memmlp.runs.run import Run
from memmlp.sweep.definition import MODES

VIEWABLE_FILES = (
    "config.yaml", "manifest.json", "metrics.jsonl", "code.patch", "FAILED", "notes.json", "poses.png",
    "actions.jsonl", "log.txt",
)  # fmt: skip
"""Run files that the page may show without changes."""

MAX_FILES = 200
MAX_TEXT = 16_000  # bytes of a log or patch on a run's page
SECONDS = "seconds"  # the curve of working time
MAX_GAP = 3600.0  # seconds between two entries; a longer gap is an interruption
MAX_POINTS = 400  # approximate maximum number of points of a curve

ROW_FACTS = (
    "id", "name", "kind", "status", "started", "finished", "seconds", "device", "tags", "note", "failure",
    "damage", "data", "data_name", "code", "steps", "recent", "signature", "batch", "since", "marks",
    "prerequisite", "archived", "stopping", "prioritized",
)  # fmt: skip
"""The facts of a run in its table row."""

Places = Mapping[str, Sequence[Mapping[str, Any]]]
"""The sweeps and searches that use a run, by run id."""


class Rows:
    """The rows of the run table. An answer has only the rows that changed since an earlier answer.

    `keys` and `metrics` of an answer are the column names of the rows' `config` and `metrics`.
    """

    def __init__(self, index: RunIndex):
        self.index = index
        self.first, self.number, self.reads = secrets.token_hex(4), 0, -1
        self.columns: dict[str, Any] = {}
        self.stamps: dict[str, tuple[Any, int]] = {}
        self.preparing: list[Any] = []
        self.changed = 0

    def update(self, places: Places) -> str:
        """Compare the runs with those of the last call, and return the state of the table."""
        runs, number, before = self.index.runs, self.number + 1, self.stamps
        self.stamps = {}
        for run_id, run in runs.items():
            stamp = run["signature"], run["status"], places.get(run_id)
            old = before.get(run_id)
            self.stamps[run_id] = old if old and old[0] == stamp else (stamp, number)
        preparing = list_preparations(self.index.outputs)
        columns = self._list_columns() if self.reads != self.index.reads else self.columns
        if columns != self.columns or before.keys() - runs.keys():
            self.columns, self.changed = columns, number
        news = self.changed == number or any(since == number for _, since in self.stamps.values())
        if news or preparing != self.preparing:
            self.number = number
        self.reads, self.preparing = self.index.reads, preparing
        return f"{self.first}-{self.number}"

    def _list_columns(self) -> dict[str, Any]:
        runs = self.index.runs
        keys = find_differing_keys(runs.values())
        metrics = list(dict.fromkeys(metric for run in runs.values() for metric in run["metrics"]))
        minor = tuple(f"{name}." for name in NEUTRAL if name != "data")
        return {
            "after": self.index.estimate_seconds_after(),
            "keys": keys,
            "minor": [key for key in keys if f"{key}.".startswith(minor)],
            "paths": list(filter(is_data_path, keys)),
            "metrics": metrics,
            "units": describe_units(metrics),
        }

    def list_since(self, state: str, places: Places) -> dict[str, Any]:
        """Return the rows that changed since a state; all rows for another state, then with `all`."""
        first, number, *_ = f"{state}--".split("-")  # behind them: a digest of sweeps and searches
        since = int(number) if first == self.first and number.isdigit() else -1
        everything = since < self.changed
        rows = [
            self._describe(run_id, places)
            for run_id, (_, changed) in self.stamps.items()
            if everything or changed > since
        ]
        about = {"unread": self.index.unread, "preparing": self.preparing, "all": everything, "rows": rows}
        return about | (self.columns if everything else {})

    def _describe(self, run_id: str, places: Places) -> dict[str, Any]:
        run = self.index.runs[run_id]
        return {
            **{key: run[key] for key in ROW_FACTS},
            "places": list(places.get(run_id, [])),
            "config": [run["config"].get(key) for key in self.columns["keys"]],
            "metrics": [_round_value(run["metrics"].get(metric), 6) for metric in self.columns["metrics"]],
        }


def find_differing_keys(runs: Iterable[Mapping[str, Any]]) -> list[str]:
    """Return the config keys with different values between runs, in the order of the configs.

    Data paths count as equal if the data is equal, because a folder has several spellings.
    """
    first: dict[str, Any] = {}
    counts: dict[str, int] = defaultdict(int)
    differing: set[str] = set()
    total = 0
    for run in runs:
        total += bool(run["config"])
        for key, value in run["config"].items():
            counts[key] += 1
            compared = run["data"] if is_data_path(key) else value
            if first.setdefault(key, compared) != compared:
                differing.add(key)
    return [key for key in first if key in differing or (counts[key] < total and not is_data_path(key))]


def describe_units(metrics: Iterable[str]) -> dict[str, dict[str, str]]:
    """Return unit and better direction of metrics, by the last part of the dotted name.

    `better` is "lower" or "higher". It is empty for a number that is not an error, such as the truth's
    Jitter. Custom metrics are left out if their package is not in use.
    """
    units = {}
    for metric in dict.fromkeys(dotted.rpartition(".")[2] for dotted in metrics):
        if metric in COSTS:
            units[metric] = {"unit": COSTS[metric], "better": "lower"}
        elif direction := find_direction(metric):
            better = "" if metric.startswith("GT ") else direction
            units[metric] = {"unit": find_unit(metric), "better": better}
    return units


def describe_run(index: RunIndex, run_id: str, control: str | None, places: Places) -> dict[str, Any]:
    """Return the content of a run's page. Raises KeyError for an unknown run.

    Args:
        index: the runs.
        run_id: the run's id.
        control: the run id of the control with the same seed, or None.
        places: the sweeps and searches by run id.
    """
    facts, run = index.runs[run_id], Run.from_id(index.outputs, run_id)
    config = _read_flat_config(run)
    clips = read_clips(run)
    return {
        **facts,
        "places": places.get(run_id, []),
        "config": config,
        "paths": list(filter(is_data_path, config)),
        "control": control
        and {
            **{key: index.runs[control][key] for key in ("id", "name", "data")},
            "config": _read_flat_config(Run.from_id(index.outputs, control)),
        },
        "manifest": flatten(run.manifest),
        "clips": clips,
        "partial": count_partial_clips(clips),
        "latency": _read_latency(run),
        "log": _read_end(run.log_path),
        "patch": _read_end(run.folder / "code.patch"),
        "traceback": records.read(run.folder / "FAILED", records.Failure).get("details", ""),
        "changed": run.verify() if run.done else [],
        "outdated": list_outdated_modes(run),
        "files": _list_files(run.folder),
    }


def _read_flat_config(run: Run) -> dict[str, Any]:
    return make_json_safe(flatten(read_config(run)))


def count_partial_clips(clips: Sequence[Mapping[str, Any]]) -> dict[str, list[int]]:
    """Return [clips with a value, all clips] by name, such as "stream.rotation.Jitter", if some have none."""
    values: dict[str, list[float]] = defaultdict(list)
    for clip in clips:
        reports = [(mode, branch, own) for mode in MODES for branch, own in clip.get(mode, {}).items()]
        for mode, branch, errors in reports:
            for metric, value in errors.items() if isinstance(errors, Mapping) else ():
                number = math.nan if value is None else float(value)
                values[f"{mode}.{branch}.{metric}"].append(number)
    counts = {name: [sum(map(math.isfinite, found)), len(clips)] for name, found in values.items()}
    return {name: both for name, both in counts.items() if both[0] < both[1]}


def read_clips(run: Run) -> list[dict[str, Any]]:
    """Return each test clip's errors by mode and branch; empty if results can't be read."""
    if not is_trained(run):
        return []
    try:
        found, solvers = load_measured_run(run.folder).clips, run.configured_evaluations.combined_solvers
    except InputError:
        return []
    return [
        {
            "name": clip,
            "frames": next((report.get("frames") for report in errors.values()), None),
            **add_solver_names({mode: errors[mode] for mode in MODES if mode in errors}, solvers),
        }
        for clip, errors in found.items()
    ]


def _read_end(path: Path) -> str:
    """Return the last lines of a text file; empty if it is missing."""
    try:
        with open(path, "rb") as file:
            file.seek(max(path.stat().st_size - MAX_TEXT, 0))
            return file.read(MAX_TEXT).decode(errors="replace")
    except OSError:
        return ""


def _read_latency(run: Run) -> dict[str, Any]:
    try:
        record = select_deployed_measurements(run.find_shown_deployment(run.config).record)
    except InputError:
        return {}
    return {key: value for key, value in flatten(record).items() if isinstance(value, int | float | str)}


def list_outdated_modes(run: Run) -> list[str]:
    """Return modes with results from an earlier component version, each with the changes since."""
    try:
        return [f"{mode} ({changes})" for mode, changes in run.configured_evaluations.outdated.items()]
    except InputError:  # `damage` in the facts lists the file
        return []


def _list_files(folder: Path) -> list[dict[str, Any]]:
    paths = sorted(path for path in folder.rglob("*") if path.is_file() and not path.name.startswith("."))
    return [
        {
            "name": str(path.relative_to(folder)),
            "bytes": path.stat().st_size,
            "viewable": path.name in VIEWABLE_FILES and path.parent == folder,
        }
        for path in paths[:MAX_FILES]
    ]


def read_curves(run: Run) -> dict[str, Any]:
    """Return a run's curves by name, such as "train loss": [steps, values], and "seconds" of work at these
    steps; None for NaN or infinity."""
    try:
        stat = run.metrics_path.stat()
        return _read_log(run.folder, stat.st_mtime_ns, stat.st_size)
    except (OSError, InputError):
        return {}


@lru_cache(1024)
def _read_log(folder: Path, *stamp: int) -> dict[str, Any]:
    series: dict[str, dict[int, float]] = defaultdict(dict)
    seconds, before = 0.0, None
    for entry in Run(folder).metrics():
        gap = entry.time - before if before is not None else 0.0
        seconds, before = seconds + (gap if 0 < gap < MAX_GAP else 0.0), entry.time
        series[SECONDS][entry.step] = round(seconds, 1)
        for name, value in entry.values.items():
            series[f"{entry.phase} {name}"][entry.step] = value
    return {name: thin_out(points) for name, points in series.items()}


def thin_out(points: Mapping[int, float | None], most: int = MAX_POINTS) -> list[list[Any]]:
    """Return steps and values. If there are over `most` points, keep minimum and maximum of each interval."""
    pairs = sorted(points.items())
    if len(pairs) > most:
        size = math.ceil(2 * len(pairs) / most)
        stretches = [range(start, min(start + size, len(pairs))) for start in range(0, len(pairs), size)]
        order = [_make_sort_value(value) for _, value in pairs]
        ends = {end(stretch, key=order.__getitem__) for stretch in stretches for end in (min, max)}
        pairs = [pairs[i] for i in sorted({0, len(pairs) - 1} | ends)]
    return [[step for step, _ in pairs], [_round_value(value, 5) for _, value in pairs]]


def _make_sort_value(value: float | None) -> float:
    return value if value is not None and math.isfinite(value) else math.inf


def _round_value(value: float | str | None, digits: int) -> float | str | None:
    """Round a number; a text is returned as it is, and None for NaN and infinity."""
    if value is None or isinstance(value, str):
        return value
    return float(f"{value:.{digits}g}") if math.isfinite(value) else None
