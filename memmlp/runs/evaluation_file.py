"""The files of evaluations, each of which contains its own digest."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from memmlp.common.errors import InputError
from memmlp.common.files import now, plain, read_json, write_json
from memmlp.runs.environment import environment
from memmlp.runs.identity import belongs, evaluation_id_of


def write_report(path: Path, report: Mapping[str, Any]) -> None:
    """Write the file of an evaluation: results, time, environment, and a digest."""
    path.parent.mkdir(parents=True, exist_ok=True)
    content = plain({**report, "made": now(), "made_by": environment()})
    write_json(path, content | {"digest": _content_digest(content)})


def read_report(path: Path) -> dict[str, Any]:
    """Read the file of an evaluation. Raises InputError if it is damaged."""
    found = read_json(path)
    if not {"mode", "mean", "clips"} <= found.keys():
        raise InputError(f"{path}: cannot be read; remove it, and the run's command makes it again")
    return found


def intact(path: Path) -> bool:
    """Return whether an evaluation's file is unchanged, and is in the folder for which it was written."""
    content = read_json(path)
    same = content.pop("digest", None) == _content_digest(content)
    named = content.get("name", path.stem) == path.stem
    return same and named and belongs(content.get("run"), path.parent.parent)


def current(path: Path, report: Mapping[str, Any]) -> bool:
    """Return whether an evaluation was made with the present recipe versions."""
    settings = report.get("settings") or {}
    return {"mode", "ik"} <= settings.keys() and path.stem == evaluation_id_of(settings)


def _content_digest(content: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]
