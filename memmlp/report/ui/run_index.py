"""The runs in an outputs folder, for the page's list. A run is read again when its files change."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from memmlp.common.errors import InputError
from memmlp.common.files import make_json_safe, read_json
from memmlp.runs.deployment_folder import select_deployed_measurements
from memmlp.runs.evaluation_file import ConfiguredEvaluations, add_solver_names
from memmlp.runs.identity import DEPLOYMENT, EVALUATION, ID, INFERENCE, find_training_settings, flatten
from memmlp.runs.lookup import get_run_name
from memmlp.runs.run import Run, name_latency

HIDDEN_GROUPS = ("paths", "loggers", "force", "hydra", "save_predictions")
"""Config groups that the page does not list."""

USE_GROUPS = {*EVALUATION, *DEPLOYMENT, *(key.split(".")[0] for key in INFERENCE)}
"""Config groups for evaluation and deployment of a trained network."""

COSTS = {
    "median_ms": "ms", "p95_ms": "ms", "pose_median_ms": "ms", "ratio_to_yardstick": "", "parameters": "",
    "macs": "", "onnx_bytes": "",
}  # fmt: skip
"""Listed costs of a deployment, with units. Lower values are better."""

FILES = ("config.yaml", "manifest.json", "metrics.jsonl", "DONE", "FAILED", "results.json", "notes.json")
TAIL_BYTES = 1 << 14  # number of bytes at the end of a metrics log that are searched for recent entries
RECENT_ENTRIES = 5  # number of training entries for the estimate of a run's speed


class RunIndex:
    """The facts of all runs.

    Attributes:
        outputs: the folder of runs and caches.
        runs: the facts by run id (`read_facts`), with the run's `status`, and a `signature` that changes with
            the run's files.
    """

    def __init__(self, outputs: Path):
        self.outputs = outputs
        self.runs: dict[str, dict[str, Any]] = {}

    def refresh(self) -> str:
        """Read changed run folders, and return a text that changes when any run changes."""
        try:
            folders = [entry for entry in (self.outputs / "runs").iterdir() if ID.fullmatch(entry.name)]
        except (FileNotFoundError, NotADirectoryError):
            folders = []
        self.runs = {folder.name: self._read_run(folder) for folder in folders if folder.is_dir()}
        return repr([(run_id, facts["signature"], facts["status"]) for run_id, facts in self.runs.items()])

    def _read_run(self, folder: Path) -> dict[str, Any]:
        signature, facts = _make_signature(folder), self.runs.get(folder.name)
        if facts is None or facts["signature"] != signature:
            facts = read_facts(folder) | {"signature": signature}
        return {**facts, "status": _read_status(folder)}


def read_facts(folder: Path) -> dict[str, Any]:
    """Return the facts of a run for the page's list; `damage` lists unreadable files."""
    run, damage = Run(folder), list[str]()
    if not (manifest := run.manifest):
        damage.append("manifest.json")
    if not (config := read_config(run)):
        damage.append("config.yaml")
    listed = select_listed_values(config)
    git, seconds = (
        found if isinstance(found := manifest.get(key), dict) else {} for key in ("git", "seconds")
    )
    numbers = [value for value in seconds.values() if isinstance(value, int | float)]
    notes = read_json(folder / "notes.json")
    return {
        "id": run.id,
        "name": get_run_name(manifest, listed),
        "kind": _convert_to_text(manifest.get("kind")),
        "done": run.done,
        "started": _convert_to_text(manifest.get("started")),
        "finished": _convert_to_text(manifest.get("finished")),
        "seconds": sum(numbers) if numbers else None,
        "code": _convert_to_text(git.get("commit") or manifest.get("version"))[:7],
        "data": _convert_to_text(manifest.get("data"))[:8],
        "data_name": _convert_to_text(listed.get("data.name")),
        "device": _convert_to_text(manifest.get("gpu")) or _convert_to_text(manifest.get("device")),
        "prerequisite": _convert_to_text(manifest.get("prerequisite")),
        "steps": manifest.get("steps") or _find_total_steps(manifest.get("kind"), config),
        "recent": read_recent_entries(run.metrics_path),
        "config": listed,
        "metrics": _read_metrics(run, {key: config[key] for key in USE_GROUPS if key in config}, damage),
        "failure": _convert_to_text(read_json(folder / "FAILED").get("reason")),
        "tags": [str(tag) for tag in notes["tags"]] if isinstance(notes.get("tags"), list) else [],
        "note": _convert_to_text(notes.get("note")),
        "damage": damage,
    }  # fmt: skip


def read_config(run: Run) -> dict[str, Any]:
    """Return a run's resolved config; empty if it is missing or damaged."""
    try:
        return run.config
    except InputError:
        return {}


def select_listed_values(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return a config's listed values by dotted key."""
    return {
        key: value
        for key, value in make_json_safe(flatten(config)).items()
        if key.split(".")[0] not in HIDDEN_GROUPS and not key.endswith(("._target_", "._partial_"))
    }


def read_recent_entries(path: Path) -> list[list[Any]]:
    """Return step, time and loss of the last training entries in a metrics log, the newest last."""
    try:
        with open(path, "rb") as file:
            file.seek(max(file.seek(0, 2) - TAIL_BYTES, 0))
            lines = file.read().split(b"\n")[:-1]
    except OSError:
        return []
    found: list[list[Any]] = []
    for line in reversed(lines):
        entry = parse_line(line)
        if entry and entry["phase"] == "train":
            loss = entry["values"].get("loss", math.nan)
            found.append([entry["step"], entry["time"], loss if math.isfinite(loss) else None])
        if len(found) == RECENT_ENTRIES:
            break
    return found[::-1]


def parse_line(line: bytes) -> dict[str, Any] | None:
    """Parse a line of a metrics log, with values as numbers; return None for an invalid line."""
    try:
        entry = json.loads(line)
        values = {str(key): float(value) for key, value in entry["values"].items()}
        step, phase, time = int(entry["step"]), str(entry["phase"]), float(entry["time"])
    except (ValueError, KeyError, TypeError, AttributeError):
        return None
    return {"step": step, "phase": phase, "time": time, "values": values}


def _find_total_steps(kind: object, config: Mapping[str, Any]) -> int | None:
    try:
        steps = find_training_settings(str(kind), config)["steps"]
    except (KeyError, TypeError):
        return None
    return steps if isinstance(steps, int) else None


def _read_metrics(run: Run, config: Mapping[str, Any], damage: list[str]) -> dict[str, float]:
    """Return metrics and costs by dotted name, such as "stream.rotation.MPJPE"."""
    found: dict[str, Any] = {}
    try:
        evaluations = ConfiguredEvaluations(run.evaluations, config)
        found |= flatten(add_solver_names(evaluations.results, evaluations.combined_solvers))
    except (InputError, KeyError, TypeError, AttributeError):
        damage.append("evaluations")
    deployed = run.find_shown_deployment(config)
    name, record = name_latency(deployed, config), select_deployed_measurements(deployed.record)
    found |= {f"{name}.{key}": record[key] for key in COSTS if key in record}
    if run.results_path.exists():
        found |= flatten(read_json(run.results_path), "vqvae.")
    return {
        key: value for key, value in found.items() if isinstance(value, int | float) and math.isfinite(value)
    }


def _read_status(folder: Path) -> str:
    try:
        return Run(folder).status
    except (KeyError, ValueError, TypeError, AttributeError):  # a damaged claim
        return "stopped"


def _make_signature(folder: Path) -> str:
    """Return a text that changes when a file with facts of the run changes."""
    stats = _stat_files(folder, FILES) + _stat_files(folder / "evaluations")
    with contextlib.suppress(OSError):
        for name in os.listdir(folder / "deployments"):
            stats += _stat_files(folder / "deployments" / name, ("latency.json",))
    return hashlib.sha256(repr(sorted(stats)).encode()).hexdigest()[:20]


def _stat_files(folder: Path, names: tuple[str, ...] | None = None) -> list[tuple[str, str, int, int]]:
    """Return folder name, file name, time and size of a folder's files, or only of the named files."""
    found = []
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if (names is None or entry.name in names) and not entry.name.startswith("."):
                stat = entry.stat()
                found.append((folder.name, entry.name, stat.st_mtime_ns, stat.st_size))
    return found


def _convert_to_text(value: object) -> str:
    return "" if value is None or isinstance(value, dict | list) else str(value)
