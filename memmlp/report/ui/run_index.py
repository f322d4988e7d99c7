"""The runs in an outputs folder, for the page's list. A run is read again when its files change."""

import contextlib
import hashlib
import math
import os
import statistics
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from memmlp.common.errors import InputError
from memmlp.common.files import is_number, make_json_safe, to_number
from memmlp.common.lease import Lock
from memmlp.common.overrides import flatten
from memmlp.common.processes import MIN_CORE_FRACTION
from memmlp.report.tables.measured_run import CORE_FRACTION_KEYS
from memmlp.runs import records
from memmlp.runs.deployment_folder import select_deployed_measurements
from memmlp.runs.evaluation_file import ConfiguredEvaluations, add_solver_names
from memmlp.runs.identity import ID, INFERENCE, NETWORK, STAGE_GROUPS, find_training_settings
from memmlp.runs.lookup import (
    count_training_frames,
    get_run_name,
    is_trained,
    read_notes,
    warn_if_hardly_trained,
)
from memmlp.runs.run import Run, name_latency

HIDDEN_GROUPS = ("paths", "loggers", "force", "hydra", "save_predictions")
"""Config groups that the page does not list."""

USE_GROUPS = {*STAGE_GROUPS, *(key.split(".")[0] for key in INFERENCE)}
"""Config groups for evaluation and deployment of a trained network."""

COSTS = {
    "median_ms": "ms", "p95_ms": "ms", "pose_median_ms": "ms", "ratio_to_yardstick": "", "parameters": "",
    "macs": "", "onnx_bytes": "",
}  # fmt: skip
"""Listed costs of a deployment, with units. Lower values are better."""

FILES = (
    "config.yaml", "manifest.json", "metrics.jsonl", "DONE", "FAILED", "STOP", "PRIORITY", "results.json",
    "notes.json", "log.txt",
)  # fmt: skip
STAGES_AFTER = ("evaluate", "export")  # the recorded times of the stages after training
QUIET_LOOKS = 200  # runs without a process that are looked at in a refresh
SETTLED = 3 * 10**9  # nanoseconds after which a folder's modification time shows any later change
RECENT_ENTRIES = 5  # number of training entries for the estimate of a run's speed


class RunIndex:
    """The facts of all runs.

    A folder that no process works on is looked at when its modification time changes, and otherwise in
    turns, because a lab has thousands of runs.

    Attributes:
        outputs: the folder of runs and caches.
        runs: the facts by run id (`read_facts`), with the run's `status`, and a `signature` that changes with
            the run's files.
        unread: the number of runs that are not read yet.
        reads: how often the facts of a run were read or removed, except new entries of a log.
    """

    def __init__(self, outputs: Path):
        self.outputs = outputs
        self.runs: dict[str, dict[str, Any]] = {}
        self.unread = self.reads = self._turn = 0

    def refresh(self, seconds: float = math.inf) -> str:
        """Read changed run folders, new ones for some seconds at most, and return a text that changes when
        any run changes."""
        end, now, found = time.monotonic() + seconds, time.time_ns(), dict[str, dict[str, Any]]()
        folders = sorted(_list_folders(self.outputs / "runs"), key=lambda one: (-one[1], one[0]))
        rounds, self._turn = math.ceil(len(folders) / QUIET_LOOKS), self._turn + 1
        for number, (name, changed) in enumerate(folders):
            facts = self.runs.get(name)
            if facts is None and time.monotonic() > end:
                continue
            its_turn = not self.unread and number % rounds == self._turn % rounds
            is_quiet = facts and facts["quiet"] == changed and not its_turn
            found[name] = facts if is_quiet and facts else self._read_run(self.outputs / "runs" / name)
            found[name]["quiet"] = changed if found[name].pop("free", True) and changed < now - SETTLED else 0
        self.reads += len(self.runs.keys() - found.keys())
        self.unread, self.runs = len(folders) - len(found), found
        return repr([(name, facts["signature"], facts["status"]) for name, facts in sorted(found.items())])

    def _read_run(self, folder: Path) -> dict[str, Any]:
        run, before = Run(folder), self.runs.get(folder.name)
        stats = _stat_files(folder, FILES) + _stat_files(folder / "evaluations")
        with contextlib.suppress(OSError):
            for name in os.listdir(folder / "deployments"):
                stats += _stat_files(folder / "deployments" / name, ("latency.json",))
        log = [stat for stat in stats if stat[1] in (run.metrics_path.name, run.log_path.name)]
        record = _digest(sorted(set(stats) - set(log)))
        signature = f"{record}-{_digest(log)}"
        if before is None or before["signature"] != signature:
            is_longer = before and before["record"] == record and not before["damage"]
            recent = _list_recent_entries(run) if is_longer else []
            if before and recent:  # otherwise the log may be damaged
                facts = {**before, "recent": recent}
            else:
                facts, self.reads = read_facts(folder), self.reads + 1
            before = facts | {"signature": signature, "record": record, "statuses": {}}
        held, statuses = run.is_held, before["statuses"]
        if held not in statuses:
            statuses[held] = run.status
        return {**before, "status": statuses[held], "free": held is None}

    def estimate_seconds_after(self) -> float | None:
        """Return the median time from the end of a network's training to the end of its run, seconds."""
        found = [run["after"] for run in self.runs.values() if run["after"] and run["kind"] == NETWORK]
        return statistics.median(found) if found else None


def get_change_time(path: Path) -> int:
    """Return a file's modification time, nanoseconds; 0 if it is missing."""
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0


def _list_folders(folder: Path) -> list[tuple[str, int]]:
    """Return name and modification time, nanoseconds, of each run's folder."""
    with contextlib.suppress(FileNotFoundError, NotADirectoryError), os.scandir(folder) as entries:
        runs = [one for one in entries if ID.fullmatch(one.name) and one.is_dir()]
        return [(one.name, one.stat().st_mtime_ns) for one in runs]
    return []


def read_facts(folder: Path) -> dict[str, Any]:
    """Return the facts of a run for the page's list; `damage` lists unreadable files."""
    run = Run(folder)
    manifest, config, notes = run.manifest, read_config(run), read_notes(run)
    listed, seconds, damage = select_listed_values(config), manifest.get("seconds"), run.damage
    return {
        "id": run.id,
        "name": notes.name or get_run_name(manifest, listed),
        "archived": notes.archived,
        "stopping": run.is_stop_requested,
        "prioritized": run.is_prioritized,
        "kind": manifest.get("kind", ""),
        "done": run.done,
        "started": manifest.get("started", ""),
        "finished": manifest.get("finished") or "",
        "seconds": sum(seconds.values()) if seconds else None,
        "code": ((manifest.get("git") or {}).get("commit") or manifest.get("version", ""))[:7],
        "data": manifest.get("data", "")[:8],
        "data_name": str(listed.get("data.name") or ""),
        "device": str(manifest.get("gpu") or manifest.get("device") or ""),
        "prerequisite": manifest.get("prerequisite") or "",
        "steps": manifest.get("steps") or run.total_steps or None,
        "batch": _read_batch(str(manifest.get("kind")), config),
        "since": (manifest.get("attempts") or [{}])[-1].get("started", ""),
        "after": sum(map((seconds or {}).get, STAGES_AFTER, (0.0, 0.0))) if run.done else None,
        "marks": {} if damage else _list_marks(run),
        "recent": _list_recent_entries(run),
        "config": listed,
        "metrics": _read_metrics(run, {key: config[key] for key in USE_GROUPS if key in config}),
        "failure": run.failure or "",
        "tags": list(notes.tags),
        "note": notes.note,
        "damage": [line.removeprefix(f"{folder}/") for line in damage],
    }  # fmt: skip


def list_preparations(outputs: Path) -> list[dict[str, Any]]:
    """Return the data sets that a process prepares now: name, and bytes that are written so far."""
    caches = [folder for folder in outputs.glob("cache/*/") if Lock(folder).is_held]
    return [{"name": one.name, "bytes": sum(f.stat().st_size for f in one.glob("*"))} for one in caches]


def _list_marks(run: Run) -> dict[str, str]:
    """Return what a reader must know about a run's numbers: a text for "errors", and one for "latency"."""
    if not is_trained(run):
        return {}
    marks = {"errors": warn_if_hardly_trained(count_training_frames(run))}
    record = select_deployed_measurements(run.find_shown_deployment(run.config).record)
    shares = [record[key] for key in CORE_FRACTION_KEYS.values() if key in record]
    if shares and min(shares) < MIN_CORE_FRACTION:
        marks["latency"] = f"timed on a busy machine: a core was free {min(shares):.0%} of the time"
    return {key: text for key, text in marks.items() if text}


def _read_batch(kind: str, config: Mapping[str, Any]) -> int | None:
    try:
        return int(find_training_settings(kind, config)["batch"])
    except (KeyError, TypeError, ValueError):
        return None


def read_config(run: Run) -> dict[str, Any]:
    """Return a run's resolved config; empty if it is missing or damaged."""
    try:
        return run.config
    except InputError:
        return {}


def select_listed_values(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return a config's listed values by dotted key."""
    return {
        sys.intern(key): sys.intern(value) if isinstance(value, str) else value  # equal in most runs
        for key, value in make_json_safe(flatten(config)).items()
        if key.split(".")[0] not in HIDDEN_GROUPS and not key.endswith(("._target_", "._partial_"))
    }


def _list_recent_entries(run: Run) -> list[list[Any]]:
    """Return step, time and loss of the last training entries in a metrics log, the newest last."""
    log = [one for one in run.recent_metrics if one.phase == "train"][-RECENT_ENTRIES:]
    losses = [one.values.get("loss", math.nan) for one in log]
    return [
        [one.step, one.time, loss if math.isfinite(loss) else None]
        for one, loss in zip(log, losses, strict=True)
    ]


def _read_metrics(run: Run, config: Mapping[str, Any]) -> dict[str, float | str]:
    """Return metrics and costs by dotted name, such as "stream.rotation.MPJPE"; a text for NaN."""
    found: dict[str, Any] = {}
    try:
        evaluations = ConfiguredEvaluations(run.evaluations, config)
        found |= flatten(add_solver_names(evaluations.results, evaluations.combined_solvers))
    except InputError:  # `damage` lists the file
        pass
    deployed = run.find_shown_deployment(config)
    name, record = name_latency(deployed, config), select_deployed_measurements(deployed.record)
    found |= {f"{name}.{key}": record[key] for key in COSTS if key in record}
    found |= flatten(records.read(run.results_path, records.Tree), "vqvae.")
    numbers = {key: to_number(value) for key, value in found.items()}
    return {
        sys.intern(key): value if math.isfinite(value) else str(value)
        for key, value in numbers.items()
        if is_number(value)
    }


def _digest(stats: list[tuple[str, str, int, int]]) -> str:
    return hashlib.sha256(repr(stats).encode()).hexdigest()[:16]


def _stat_files(folder: Path, names: tuple[str, ...] | None = None) -> list[tuple[str, str, int, int]]:
    """Return folder name, file name, time and size of a folder's files, or only of the named files."""
    found = []
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if (names is None or entry.name in names) and not entry.name.startswith("."):
                stat = entry.stat()
                found.append((folder.name, entry.name, stat.st_mtime_ns, stat.st_size))
    return found
