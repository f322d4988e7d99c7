"""The answers about runs: the table's rows, a run's page, and curves."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

from memmlp.common.errors import InputError
from memmlp.common.files import make_json_safe, read_json
from memmlp.report.tables.measured_run import load
from memmlp.report.tables.table_text import find_direction, find_unit
from memmlp.report.ui.run_index import COSTS, RunIndex, parse_line, read_config
from memmlp.runs.deployment_folder import select_deployed_measurements
from memmlp.runs.evaluation_file import name_solvers
from memmlp.runs.identity import NETWORK, NEUTRAL, flatten, is_data_path
from memmlp.runs.lookup import count_training_frames, is_trained, warn_if_hardly_trained
from memmlp.runs.run import Run

VIEWABLE = (
    "config.yaml", "manifest.json", "metrics.jsonl", "code.patch", "FAILED", "notes.json", "poses.png",
)  # fmt: skip
"""Files of a run that the page may open unchanged."""

MAX_FILES = 200
MAX_POINTS = 400  # of a curve, about

ROW = (
    "id", "name", "kind", "status", "started", "finished", "seconds", "device", "tags", "note", "failure",
    "damage", "data", "data_name", "code", "steps", "recent", "signature",
)  # fmt: skip
"""The facts of a run that its row has."""

Places = Mapping[str, Sequence[Mapping[str, Any]]]
"""By run id, the sweeps and searches that use the run."""


def list_rows(index: RunIndex, places: Places) -> dict[str, Any]:
    """Return a row for each run; `keys` and `metrics` name the values of its `config` and `metrics`."""
    runs = index.runs
    keys = differing_keys(runs.values())
    metrics = list(dict.fromkeys(metric for run in runs.values() for metric in run["metrics"]))
    minor = [name for name in NEUTRAL if name != "data"]
    return {
        "keys": keys,
        "minor": [key for key in keys if any(key == name or key.startswith(f"{name}.") for name in minor)],
        "paths": list(filter(is_data_path, keys)),
        "metrics": metrics,
        "units": describe_units(metrics),
        "rows": [
            {
                **{key: run[key] for key in ROW},
                "places": list(places.get(run_id, [])),
                "config": [run["config"].get(key) for key in keys],
                "metrics": [_round(run["metrics"].get(metric), 6) for metric in metrics],
            }
            for run_id, run in runs.items()
        ],
    }


def differing_keys(runs: Iterable[Mapping[str, Any]]) -> list[str]:
    """Return the config keys in which runs differ, in the order of the configs.

    Paths of data differ only if the data differs, since one folder has several spellings.
    """
    first: dict[str, Any] = {}
    counts: dict[str, int] = defaultdict(int)
    differing: set[str] = set()
    total = 0
    for run in runs:
        total += bool(run["config"])
        for key, value in run["config"].items():
            counts[key] += 1
            meant = run["data"] if is_data_path(key) else value
            if first.setdefault(key, meant) != meant:
                differing.add(key)
    return [key for key in first if key in differing or (counts[key] < total and not is_data_path(key))]


def describe_units(metrics: Iterable[str]) -> dict[str, dict[str, str]]:
    """Return the units of metrics, and which direction is better, by the last word of the metrics' names.

    `better` is "lower" or "higher", or empty for a number that is not an error, such as the truth's Jitter.
    A custom metric is left out if its package is not in use.
    """
    found = {}
    for metric in dict.fromkeys(dotted.rpartition(".")[2] for dotted in metrics):
        if metric in COSTS:
            found[metric] = {"unit": COSTS[metric], "better": "lower"}
        elif direction := find_direction(metric):
            found[metric] = {
                "unit": find_unit(metric),
                "better": "" if metric.startswith("GT ") else direction,
            }
    return found


def describe_run(index: RunIndex, run_id: str, control: str | None, places: Places) -> dict[str, Any]:
    """Return everything that a run's page shows. Raises KeyError for an unknown run.

    Args:
        index: the runs.
        run_id: the run's id.
        control: the id of the run with which its variant is compared; None for none.
        places: the sweeps and searches by run.
    """
    facts, run = index.runs[run_id], Run.from_id(index.outputs, run_id)
    config = _read_flat_config(run)
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
        "clips": read_clips(run),
        "latency": _read_latency(run),
        "changed": run.verify() if run.done else [],
        "outdated": outdated_modes(run),
        "remark": _warn_of_short_training(run) if facts["kind"] == NETWORK and not facts["damage"] else "",
        "files": _list_files(run.folder),
    }


def _read_flat_config(run: Run) -> dict[str, Any]:
    return make_json_safe(flatten(read_config(run)))


def read_clips(run: Run) -> list[dict[str, Any]]:
    """Return the errors of each test clip by mode and branch; empty if they can't be read."""
    if not is_trained(run):
        return []
    try:
        found, evaluations = load(run.folder).clips, run.evaluations_as_configured
        solvers = evaluations.combined_solvers
        frames = {
            report["name"]: report.get("frames")
            for path in evaluations.paths
            for report in read_json(path).get("clips", [])
        }
    except (InputError, KeyError, TypeError):
        return []
    return [
        {
            "name": clip,
            "frames": frames.get(clip),
            **name_solvers({mode: errors[mode] for mode in ("stream", "window") if mode in errors}, solvers),
        }
        for clip, errors in found.items()
    ]


def _read_latency(run: Run) -> dict[str, Any]:
    """Return the measurements of the deployment that the run's config asks for."""
    try:
        record = select_deployed_measurements(run.deployment_as_configured.record)
    except InputError:
        return {}
    return {key: value for key, value in flatten(record).items() if isinstance(value, int | float | str)}


def outdated_modes(run: Run) -> list[str]:
    """Return the modes that an earlier component version measured, each with the changes since."""
    try:
        return [f"{mode} ({changes})" for mode, changes in run.evaluations_as_configured.outdated.items()]
    except InputError:  # the facts name the damaged file
        return []


def _warn_of_short_training(run: Run) -> str:
    try:
        return warn_if_hardly_trained(count_training_frames(run))
    except (ValueError, TypeError, AttributeError):
        return ""


def _list_files(folder: Path) -> list[dict[str, Any]]:
    paths = sorted(path for path in folder.rglob("*") if path.is_file() and not path.name.startswith("."))
    return [
        {
            "name": str(path.relative_to(folder)),
            "bytes": path.stat().st_size,
            "viewable": path.name in VIEWABLE and path.parent == folder,
        }
        for path in paths[:MAX_FILES]
    ]


def read_curves(run: Run) -> dict[str, Any]:
    """Return a run's curves by name, such as "train loss": [steps, values]; None is a missing number."""
    try:
        stat = run.metrics_path.stat()
    except OSError:
        return {}
    return _parse_log(run.metrics_path, stat.st_mtime_ns, stat.st_size)


@lru_cache(1024)
def _parse_log(path: Path, *stamp: int) -> dict[str, Any]:
    series: dict[str, dict[int, float]] = defaultdict(dict)
    for line in path.read_bytes().splitlines():
        if entry := parse_line(line):
            for name, value in entry["values"].items():
                series[f"{entry['phase']} {name}"][entry["step"]] = value
    return {name: thin_out(points) for name, points in series.items()}


def thin_out(points: Mapping[int, float | None], most: int = MAX_POINTS) -> list[list[Any]]:
    """Return steps and values; of many, only the smallest and the largest in each stretch."""
    pairs = sorted(points.items())
    if len(pairs) > most:
        size = math.ceil(2 * len(pairs) / most)
        stretches = [range(start, min(start + size, len(pairs))) for start in range(0, len(pairs), size)]
        order = [_order(value) for _, value in pairs]
        ends = {end(stretch, key=order.__getitem__) for stretch in stretches for end in (min, max)}
        pairs = [pairs[i] for i in sorted({0, len(pairs) - 1} | ends)]
    return [[step for step, _ in pairs], [_round(value, 5) for _, value in pairs]]


def _order(value: float | None) -> float:
    return value if value is not None and math.isfinite(value) else math.inf


def _round(value: float | None, digits: int) -> float | None:
    return None if value is None or not math.isfinite(value) else float(f"{value:.{digits}g}")
