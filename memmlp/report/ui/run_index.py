"""The runs below an outputs folder, as the page lists them; a run is read again when its files change."""

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
from memmlp.runs.evaluation_file import EvaluationsAsConfigured, name_solvers
from memmlp.runs.identity import DEPLOYMENT, EVALUATION, ID, INFERENCE, find_training_settings, flatten
from memmlp.runs.lookup import get_run_name
from memmlp.runs.run import Run, name_latency

HIDDEN = ("paths", "loggers", "force", "hydra", "save_predictions")
"""Config groups that are not listed."""

USE = {*EVALUATION, *DEPLOYMENT, *(key.split(".")[0] for key in INFERENCE)}
"""Config groups that say how a trained network is evaluated and deployed."""

COSTS = {
    "median_ms": "ms", "p95_ms": "ms", "pose_median_ms": "ms", "ratio_to_yardstick": "", "parameters": "",
    "macs": "", "onnx_bytes": "",
}  # fmt: skip
"""The listed costs of a deployment, with units; lower is better."""

FILES = ("config.yaml", "manifest.json", "metrics.jsonl", "DONE", "FAILED", "results.json", "notes.json")
TAIL = 1 << 14  # bytes at the end of a metrics log in which the last entries are looked for
RECENT = 5  # number of training entries from which the speed of a run is estimated


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
        """Look at all run folders again, and return a text that changes with any of them."""
        try:
            folders = [entry for entry in (self.outputs / "runs").iterdir() if ID.fullmatch(entry.name)]
        except (FileNotFoundError, NotADirectoryError):
            folders = []
        self.runs = {folder.name: self._look(folder) for folder in folders if folder.is_dir()}
        return repr([(run_id, facts["signature"], facts["status"]) for run_id, facts in self.runs.items()])

    def _look(self, folder: Path) -> dict[str, Any]:
        signature, facts = _signature(folder), self.runs.get(folder.name)
        if facts is None or facts["signature"] != signature:
            facts = read_facts(folder) | {"signature": signature}
        return {**facts, "status": _read_status(folder)}


def read_facts(folder: Path) -> dict[str, Any]:
    """Return what is listed of a run; `damage` names the files that cannot be read."""
    run, damage = Run(folder), list[str]()
    if not (manifest := run.manifest):
        damage.append("manifest.json")
    if not (config := read_config(run)):
        damage.append("config.yaml")
    listed = select_listed(config)
    git, seconds = (
        found if isinstance(found := manifest.get(key), dict) else {} for key in ("git", "seconds")
    )
    numbers = [value for value in seconds.values() if isinstance(value, int | float)]
    notes = read_json(folder / "notes.json")
    return {
        "id": run.id,
        "name": get_run_name(manifest, listed),
        "kind": _text(manifest.get("kind")),
        "done": run.done,
        "started": _text(manifest.get("started")),
        "finished": _text(manifest.get("finished")),
        "seconds": sum(numbers) if numbers else None,
        "code": _text(git.get("commit") or manifest.get("version"))[:7],
        "data": _text(manifest.get("data"))[:8],
        "data_name": _text(listed.get("data.name")),
        "device": _text(manifest.get("gpu")) or _text(manifest.get("device")),
        "prerequisite": _text(manifest.get("prerequisite")),
        "steps": _total_steps(manifest.get("kind"), config),
        "recent": read_recent(run.metrics_path),
        "config": listed,
        "metrics": _read_metrics(run, {key: config[key] for key in USE if key in config}, damage),
        "failure": _text(read_json(folder / "FAILED").get("reason")),
        "tags": [str(tag) for tag in notes["tags"]] if isinstance(notes.get("tags"), list) else [],
        "note": _text(notes.get("note")),
        "damage": damage,
    }  # fmt: skip


def read_config(run: Run) -> dict[str, Any]:
    """Return a run's resolved config; empty if it is missing or damaged."""
    try:
        return run.config
    except InputError:
        return {}


def select_listed(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return a config's listed values by dotted key."""
    return {
        key: value
        for key, value in make_json_safe(flatten(config)).items()
        if key.split(".")[0] not in HIDDEN and not key.endswith(("._target_", "._partial_"))
    }


def read_recent(path: Path) -> list[list[Any]]:
    """Return step, time and loss of a metrics log's last training entries, the newest last."""
    try:
        with open(path, "rb") as file:
            file.seek(max(file.seek(0, 2) - TAIL, 0))
            lines = file.read().split(b"\n")[:-1]
    except OSError:
        return []
    found: list[list[Any]] = []
    for line in reversed(lines):
        entry = parse_line(line)
        if entry and entry["phase"] == "train":
            loss = entry["values"].get("loss", math.nan)
            found.append([entry["step"], entry["time"], loss if math.isfinite(loss) else None])
        if len(found) == RECENT:
            break
    return found[::-1]


def parse_line(line: bytes) -> dict[str, Any] | None:
    """Return the entry in a line of a metrics log, its values as numbers; None if it does not hold one."""
    try:
        entry = json.loads(line)
        values = {str(key): float(value) for key, value in entry["values"].items()}
        step, phase, time = int(entry["step"]), str(entry["phase"]), float(entry["time"])
    except (ValueError, KeyError, TypeError, AttributeError):
        return None
    return {"step": step, "phase": phase, "time": time, "values": values}


def _total_steps(kind: object, config: Mapping[str, Any]) -> int | None:
    try:
        steps = find_training_settings(str(kind), config)["steps"]
    except (KeyError, TypeError):
        return None
    return steps if isinstance(steps, int) else None


def _read_metrics(run: Run, config: Mapping[str, Any], damage: list[str]) -> dict[str, float]:
    """Return the measured numbers by dotted name, such as "stream.rotation.MPJPE"."""
    found: dict[str, Any] = {}
    try:
        evaluations = EvaluationsAsConfigured(run.evaluations, config)
        found |= flatten(name_solvers(evaluations.results, evaluations.combined_solvers))
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


def _signature(folder: Path) -> str:
    """Return a text that changes when any file changes from which a run's facts come."""
    stats = _stat_files(folder, FILES) + _stat_files(folder / "evaluations")
    with contextlib.suppress(OSError):
        for name in os.listdir(folder / "deployments"):
            stats += _stat_files(folder / "deployments" / name, ("latency.json",))
    return hashlib.sha256(repr(sorted(stats)).encode()).hexdigest()[:20]


def _stat_files(folder: Path, names: tuple[str, ...] | None = None) -> list[tuple[str, str, int, int]]:
    """Return name, time and size of a folder's files, either of certain names or all."""
    found = []
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if (names is None or entry.name in names) and not entry.name.startswith("."):
                stat = entry.stat()
                found.append((folder.name, entry.name, stat.st_mtime_ns, stat.st_size))
    return found


def _text(value: object) -> str:
    return "" if value is None or isinstance(value, dict | list) else str(value)
