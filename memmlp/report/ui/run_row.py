"""The facts in a run's folder that the table of runs shows; a damaged folder has facts, too."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import yaml

from memmlp.common.files import plain, read_json
from memmlp.runs.deployment_folder import as_deployed
from memmlp.runs.evaluation_file import combined_by, of_one_solver, preference, with_solvers
from memmlp.runs.former_keys import with_present_names
from memmlp.runs.identity import (
    DEPLOYMENT,
    EVALUATION,
    INFERENCE,
    NETWORK,
    flatten,
    training_settings,
    used_as_configured,
)
from memmlp.runs.motion_seen import frames_seen, hardly_trained
from memmlp.runs.run import Run, latency_name
from memmlp.runs.shown_name import run_name

HIDDEN = ("paths", "loggers", "force", "hydra", "save_predictions")
"""Config groups that are not shown with a run."""

ACTING = {*EVALUATION, *DEPLOYMENT, *(key.split(".")[0] for key in INFERENCE)}
"""Groups of the config that say how a trained network is used and deployed."""

TAIL = 1 << 14  # bytes at the end of a metrics log in which its last entries are looked for
RATE = 5  # how many of its last training entries tell how fast a run is
COSTS = {
    "median_ms": "ms", "p95_ms": "ms", "pose_median_ms": "ms", "ratio_to_yardstick": "",
    "parameters": "", "macs": "",
    "onnx_bytes": "",
}  # fmt: skip
"""The costs of a deployment that are shown, with units; lower is better."""

Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def facts(folder: Path) -> dict[str, Any]:
    """Return the facts in a run's folder for the table of runs; `damage` lists what could not be read."""
    run, damage = Run(folder), list[str]()
    manifest = _object(run.manifest_path, damage)
    config, shown = _config(run.config_path, damage)
    used = {name: config[name] for name in ACTING if name in config}
    reports = _reports(run, used, damage)
    recent = last_entries(run.metrics_path)
    return {
        "id": run.id,
        "name": run_name(manifest, shown),
        "kind": _word(manifest.get("kind")),
        "done": run.done,
        "complete": run.complete,
        "started": _word(manifest.get("started")),
        "finished": _word(manifest.get("finished")),
        "seconds": _seconds(manifest.get("seconds")),
        "code": _code(manifest),
        "data": _word(manifest.get("data"))[:8],
        "data_name": _word(shown.get("data.name")),
        "device": _word(manifest.get("gpu")) or _word(manifest.get("device")),
        "host": _word(manifest.get("host")),
        "upstream": _word(manifest.get("upstream")),
        "steps": total_steps(manifest.get("kind"), config),
        "recent": recent,
        "config": shown,
        "metrics": _metrics(run, used, reports),
        "failure": _word(read_json(folder / "FAILED").get("reason")),
        **_notes(folder),
        "damage": damage,
        "remark": _remark(run) if manifest.get("kind") == NETWORK and not damage else "",
    }


def _remark(run: Run) -> str:
    """Return a warning if the network saw next to no motion; empty if it saw enough, or that is unknown."""
    try:
        return hardly_trained(frames_seen(run))
    except (ValueError, TypeError, AttributeError):  # a config that is none
        return ""


def last_entries(path: Path) -> list[list[Any]]:
    """Return step, time and loss of a log's last training entries, the newest last."""
    try:
        with open(path, "rb") as file:
            file.seek(max(file.seek(0, 2) - TAIL, 0))
            lines = file.read().split(b"\n")[:-1]
    except OSError:
        return []
    found: list[list[Any]] = []
    for line in reversed(lines):
        entry = parsed_line(line)
        if entry and entry["phase"] == "train":
            found.append([entry["step"], entry["time"], finite(entry["values"].get("loss"))])
        if len(found) == RATE:
            break
    return found[::-1]


def parsed_line(line: bytes) -> dict[str, Any] | None:
    """Return the entry in a line of a metrics log, its values as numbers; None if there is none."""
    try:
        entry = json.loads(line)
        values = {str(key): float(value) for key, value in entry["values"].items()}
        return {
            "step": int(entry["step"]),
            "phase": str(entry["phase"]),
            "time": float(entry["time"]),
            "values": values,
        }
    except (ValueError, KeyError, TypeError, AttributeError):
        return None


def finite(value: float | None) -> float | None:
    """Return a number; None for None, NaN and infinity."""
    return value if value is not None and math.isfinite(value) else None


def total_steps(kind: object, config: Mapping[str, Any]) -> int | None:
    """Return the number of steps of a run's training; None if its config does not have it."""
    try:
        steps = training_settings(str(kind), config)["steps"]
    except (KeyError, TypeError):
        return None
    return steps if isinstance(steps, int) else None


def read_config(path: Path) -> dict[str, Any]:
    """Read a resolved config. Raises ValueError if the file has none.

    The runs of a sweep share most groups of their configs, so each group's text is parsed only once.
    """
    return _parsed(path)[0]


def _parsed(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return a file's config, and those of its dotted keys that are shown. Raises ValueError."""
    try:
        groups = [_group(group) for group in re.split(r"\n(?=[^\s#-])", path.read_text(encoding="utf-8"))]
    except (OSError, UnicodeDecodeError, yaml.YAMLError, TypeError) as error:
        raise ValueError(str(error)) from None
    config: dict[str, Any] = {}
    shown: dict[str, Any] = {}
    for tree, flat in groups:
        config |= tree
        shown |= flat
    return config, shown


@lru_cache(4096)
def _group(text: str) -> tuple[dict[str, Any], dict[str, Any]]:
    found = yaml.load(text, Loader)  # a safe loader
    if not isinstance(found, dict):
        raise TypeError("no config")
    found = with_present_names(found)
    return found, {key: value for key, value in plain(flatten(found)).items() if _shown(key)}


def _config(path: Path, damage: list[str]) -> tuple[dict[str, Any], dict[str, Any]]:
    try:
        return _parsed(path)
    except ValueError:
        damage.append(path.name)
        return {}, {}


def _object(path: Path, damage: list[str]) -> dict[str, Any]:
    """Return the object in a JSON file; if there is none, the file's name is added to the damage."""
    found = read_json(path)
    if not found:
        damage.append(path.name)
    return found


def _shown(key: str) -> bool:
    return key.split(".")[0] not in HIDDEN and not key.endswith(("._target_", "._partial_"))


def _reports(run: Run, config: Mapping[str, Any], damage: list[str]) -> list[dict[str, Any]]:
    """Return the evaluations that use the network as the run's config does, the one that counts last."""
    found = []
    for path in sorted(run.evaluations.glob("*.json")):
        report = read_json(path)
        if not isinstance(report.get("mean"), dict) or not isinstance(report.get("settings", {}), dict):
            damage.append(f"{path.parent.name}/{path.name}")
        elif used_as_configured(report.get("settings", {}), config):
            found.append((preference(path, report, config), report))
    return [report for _, report in sorted(found, key=lambda one: one[0])]


def _metrics(run: Run, config: Mapping[str, Any], reports: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Return the measured numbers by dotted name, such as "stream.rotation.MPJPE"."""
    found: dict[str, Any] = {}
    means = [{key: report.get(key) for key in ("mode", "settings", "mean")} for report in reports]
    by = combined_by(means)
    for report in of_one_solver(means):
        found |= flatten(with_solvers({str(report.get("mode")): report["mean"]}, by))
    deployed = run.deployment_shown(config)
    name, record = latency_name(deployed, config), as_deployed(deployed.record)
    found |= {f"{name}.{key}": record[key] for key in COSTS if key in record}
    if run.results_path.exists():
        found |= flatten(read_json(run.results_path), "vqvae.")
    return {
        key: value for key, value in found.items() if isinstance(value, int | float) and math.isfinite(value)
    }


def _code(manifest: Mapping[str, Any]) -> str:
    """Return the commit of the code that made the run, or its version."""
    git = manifest.get("git")
    commit = git.get("commit") if isinstance(git, dict) else None
    return _word(commit or manifest.get("version"))[:7]


def _seconds(value: object) -> float | None:
    """Return how long a run took; None if its manifest does not say."""
    if not isinstance(value, dict):
        return None
    numbers = [part for part in value.values() if isinstance(part, int | float)]
    return float(sum(numbers)) if numbers else None


def _notes(folder: Path) -> dict[str, Any]:
    """Return the run's tags and note."""
    found = read_json(folder / "notes.json")
    tags = found.get("tags")
    return {
        "tags": [str(tag) for tag in tags] if isinstance(tags, list) else [],
        "note": _word(found.get("note")),
    }


def _word(value: object) -> str:
    return "" if value is None or isinstance(value, dict | list) else str(value)
