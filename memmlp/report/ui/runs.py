"""The content of the pages of runs: the table's rows, and everything about a single run."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from memmlp.common.errors import InputError
from memmlp.common.files import read_json
from memmlp.report.ui.index import Index
from memmlp.report.ui.run_row import COSTS, read_config
from memmlp.runs.deployment_folder import as_deployed
from memmlp.runs.evaluation_file import with_solvers
from memmlp.runs.identity import NEUTRAL, flatten, is_data_path
from memmlp.runs.lookup import is_trained
from memmlp.runs.run import Run
from memmlp.tables.measured_run import load
from memmlp.tables.table_text import better, unit

SHOWN_FILES = (
    "config.yaml",
    "manifest.json",
    "metrics.jsonl",
    "code.patch",
    "FAILED",
    "notes.json",
    "poses.png",
)
"""Files of a run that the page may show unchanged."""

MOST_FILES = 200


class Rows:
    """The rows of the table of runs, for a page that may have some of them already."""

    def __init__(self, index: Index, places: Callable[[], Mapping[str, Sequence[Mapping[str, Any]]]]):
        self.index, self.places = index, places

    def since(self, generation: int, heads: str = "") -> dict[str, Any]:
        """Return the rows that changed after a generation, and the runs that were deleted.

        `keys` and `metrics` are the heads of each row's `config` and `metrics`. If they differ from those
        that the page has (`heads`), all rows are returned.
        """
        with self.index.lock:
            runs, now, removed = dict(self.index.runs), self.index.generation, dict(self.index.removed)
        where = self.places()
        keys, metrics = differing(runs.values()), measured(runs.values())
        known = "|".join([*keys, *metrics, str(sum(map(len, where.values())))])
        whole = generation == 0 or heads != str(hash(known))
        rows = [
            row(run, keys, metrics, where.get(run_id, []))
            for run_id, run in runs.items()
            if whole or run["generation"] > generation
        ]
        gone = [run_id for run_id, when in removed.items() if when > generation]
        return {
            "generation": now,
            "heads": str(hash(known)),
            "whole": whole,
            "keys": keys,
            "minor": minor(keys),
            "paths": list(filter(is_data_path, keys)),
            "metrics": metrics,
            "units": units(metrics),
            "sets": sets(runs.values()),
            "shared": shared(runs.values()),
            "rows": rows,
            "removed": gone,
        }


def row(
    facts: Mapping[str, Any], keys: Sequence[str], metrics: Sequence[str], where: Sequence[Mapping[str, Any]]
) -> dict[str, Any]:
    """Return a run's row in the table."""
    own = (
        "id",
        "name",
        "kind",
        "status",
        "started",
        "finished",
        "seconds",
        "device",
        "tags",
        "note",
        "failure",
        "damage",
        "data",
        "code",
        "steps",
        "recent",
    )
    return {
        **{key: facts[key] for key in own},
        "places": list(where),
        "config": [facts["config"].get(key) for key in keys],
        "metrics": [_short(facts["metrics"].get(metric)) for metric in metrics],
    }


def differing(runs: Any) -> list[str]:
    """Return the config keys in which runs differ, in the order of the configs.

    Paths of data count as different only if the data differs, however they are spelled.
    """
    first: dict[str, Any] = {}
    counts: dict[str, int] = {}
    found: dict[str, None] = {}
    total = 0
    for run in runs:
        total += bool(run["config"])
        for key, value in run["config"].items():
            counts[key] = counts.get(key, 0) + 1
            meant = run["data"] if is_data_path(key) else value
            if first.setdefault(key, meant) != meant:
                found[key] = None
    return [key for key in first if key in found or (counts[key] < total and not is_data_path(key))]


def minor(keys: Sequence[str]) -> list[str]:
    """Return the keys that do not change results, and `profile`, whose choices appear in other keys."""
    groups = [name for name in NEUTRAL if name != "data"]
    return [key for key in keys if any(key == name or key.startswith(f"{name}.") for name in groups)]


def measured(runs: Any) -> list[str]:
    """Return the names of all numbers that were measured for any run."""
    return list(dict.fromkeys(metric for run in runs for metric in run["metrics"]))


def sets(runs: Iterable[Mapping[str, Any]]) -> dict[str, str]:
    """Return the name and short digest of runs' data, by short digest: `mocap 78bb7c86`.

    A VQ-VAE's config does not name its data; the config of a network on the same data does.
    """
    named = {run["data"]: run["data_name"] for run in runs if run["data"] and run["data_name"]}
    return {data: f"{name} {data}" for data, name in named.items()}


def shared(runs: Iterable[Mapping[str, Any]]) -> list[str]:
    """Return the names that several datasets share, so that a digest must be added."""
    found: dict[str, set[str]] = {}
    for run in runs:
        found.setdefault(run["name"], set()).add(run["data"])
    return sorted(name for name, data in found.items() if len(data) > 1)


def units(metrics: Iterable[str]) -> dict[str, dict[str, str]]:
    """Return the units of metrics, and which direction is better, by the last word of the metrics' names.

    `better` is "lower" or "higher", and empty for a number that is no error, such as the truth's Jitter. A
    custom metric whose package is not in use is left out.
    """
    found = {}
    for metric in dict.fromkeys(dotted.rpartition(".")[2] for dotted in metrics):
        if metric in COSTS:
            found[metric] = {"unit": COSTS[metric], "better": "lower"}
        elif way := better(metric):
            found[metric] = {"unit": unit(metric), "better": "" if metric.startswith("GT ") else way}
    return found


def _short(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.6g}")


def page(
    index: Index, control: str | None, every: Mapping[str, Sequence[Mapping[str, Any]]], run_id: str
) -> dict[str, Any]:
    """Return everything that a run's page shows. Raises KeyError for an unknown run.

    Args:
        index: the runs.
        control: the id of the run's control (`Sweeps.control_of`); None for none.
        every: the places of all runs (`places`).
        run_id: the run's id.
    """
    with index.lock:
        facts = dict(index.runs[run_id])
        known = dict(index.runs)
    run = Run.of(index.outputs, run_id)
    where, config = every.get(run_id, []), whole_config(run)
    return {
        **facts,
        "places": where,
        "config": config,
        "paths": list(filter(is_data_path, config)),
        "partners": partners(known, run_id, control),
        "control": control
        and {
            "id": control,
            "name": known[control]["name"],
            "data": known[control]["data"],
            "config": whole_config(Run.of(index.outputs, control)),
        },
        "manifest": flatten(run.manifest),
        "clips": clips(run),
        "latency": latency(run),
        "changed": verified(run),
        "older": by_earlier_recipes(run),
        "files": files(run.folder),
    }


def whole_config(run: Run) -> dict[str, Any]:
    """Return a run's config by dotted key; empty if it can't be read."""
    try:
        return flatten(read_config(run.config_path))
    except ValueError:
        return {}


def partners(known: Mapping[str, Mapping[str, Any]], run_id: str, control: str | None = None) -> list[str]:
    """Return the trained networks on a run's own data, with the one to compare it with first.

    The first is its control, then come those with its seed whose configs differ in the fewest groups and
    keys. Keys that do not change results are ignored. Runs on other data are left out, since their errors
    can't be compared.
    """
    own = known[run_id]
    near = {
        other["id"]: differences(own["config"], other["config"])
        for other in known.values()
        if other["id"] != run_id
        and other["kind"] == "memmlp"
        and other["status"] in ("done", "trained")
        and other["data"] == own["data"]
    }

    def far(other: str) -> tuple[bool, bool, int, int, str]:
        keys = near[other]
        return other != control, "seed" in keys, len({key.split(".")[0] for key in keys}), len(keys), other

    return sorted(near, key=far)


def differences(one: Mapping[str, Any], other: Mapping[str, Any]) -> list[str]:
    """Return the keys in which two configs differ, without those that do not change results."""
    keys = [key for key in {**one, **other} if one.get(key) != other.get(key)]
    neutral = {*minor(keys), *filter(is_data_path, keys)}
    return [key for key in keys if key not in neutral]


def clips(run: Run) -> list[dict[str, Any]]:
    """Return the errors of each test clip by mode and branch; empty if they can't be read."""
    if not is_trained(run):
        return []
    try:
        found, evaluations = load(run.folder).clips, run.evaluations_as_configured
        by = evaluations.combined_by
        own = {
            report["name"]: report.get("frames")
            for path in evaluations.paths
            for report in read_json(path).get("clips", [])
        }
    except (InputError, KeyError, TypeError):
        return []
    return [
        {
            "name": clip,
            "frames": own.get(clip),
            **with_solvers({mode: errors[mode] for mode in ("stream", "window") if mode in errors}, by),
        }
        for clip, errors in found.items()
    ]


def latency(run: Run) -> dict[str, Any]:
    """Return the measurements of the deployment that the run shows, of the file that was asked for."""
    try:
        record = as_deployed(run.deployment_as_configured.record)
    except InputError:
        return {}
    return {key: value for key, value in flatten(record).items() if isinstance(value, int | float | str)}


def verified(run: Run) -> list[str]:
    """Return the files of a finished run that are missing or have changed since."""
    return run.verify() if run.done else []


def by_earlier_recipes(run: Run) -> list[str]:
    """Return the modes that a run was measured in by an earlier recipe, each with what has changed since."""
    try:
        return [f"{mode} ({words})" for mode, words in run.evaluations_as_configured.outdated.items()]
    except InputError:  # the facts tell of a damaged file
        return []


def files(folder: Path) -> list[dict[str, Any]]:
    """Return the files of a run's folder, with their sizes."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file() and not path.name.startswith("."))
    return [
        {
            "name": str(path.relative_to(folder)),
            "bytes": path.stat().st_size,
            "shown": path.name in SHOWN_FILES and path.parent == folder,
        }
        for path in paths[:MOST_FILES]
    ]
