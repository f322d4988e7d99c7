"""The files of evaluations, each of which contains its own digest."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from memmlp.common.errors import InputError
from memmlp.common.files import now, plain, read_json, write_json
from memmlp.runs.component_versions import outdated, version_of
from memmlp.runs.environment import environment
from memmlp.runs.identity import belongs, evaluation_id_of, solver_of

COMBINED = "combined"
"""The branch of the rotations after inverse kinematics, by the solver in the settings of the evaluation."""


def write_report(path: Path, report: Mapping[str, Any]) -> None:
    """Write the file of an evaluation: results, time, environment, and a digest."""
    path.parent.mkdir(parents=True, exist_ok=True)
    content = plain({**report, "made": now(), "made_by": environment()})
    write_json(path, content | {"digest": _content_digest(content)})


def read_report(path: Path) -> dict[str, Any]:
    """Read the file of an evaluation. Raises InputError if it is damaged."""
    report = read_json(path)
    check_report(path, report)
    return report


def check_report(path: Path, report: Mapping[str, Any]) -> None:
    """Raise InputError if what was read from the file of an evaluation is not a report."""
    if not {"mode", "mean", "clips"} <= report.keys():
        raise InputError(f"{path}: cannot be read; remove it, and repeat the run's command to evaluate again")


def intact(path: Path) -> bool:
    """Return whether an evaluation's file is unchanged, and is in the folder for which it was written."""
    content = read_json(path)
    same = content.pop("digest", None) == _content_digest(content)
    named = content.get("name", path.stem) == path.stem
    return same and named and belongs(content.get("run"), path.parent.parent)


def current(path: Path, report: Mapping[str, Any]) -> bool:
    """Return whether an evaluation was made with the current component versions."""
    settings = report.get("settings") or {}
    return {"mode", "ik"} <= settings.keys() and path.stem == evaluation_id_of(settings)


def outdated_by(path: Path, report: Mapping[str, Any]) -> str | None:
    """Return which components of an evaluation have changed since, as "mode.window 2 -> 3"; None if none has.

    Custom metrics whose package is not in use are not compared.
    """
    known = {
        name: number for name, number in report.get("component_versions", {}).items() if version_of(name)
    }
    return ", ".join(outdated(known)) or None


def preference(path: Path, report: Mapping[str, Any], config: Mapping[str, Any]) -> tuple[bool, bool, str]:
    """Return a key that sorts a run's evaluations, the one that counts last.

    Current component versions matter most, then the inverse kinematics of the run's config, then the time.
    """
    settings = report.get("settings") or {}
    own = solver_of(settings) == solver_of(config.get("evaluation") or {})
    return current(path, report), own, str(report.get("made"))


def combined_by(reports: Sequence[Mapping[str, Any]]) -> dict[str, str | None]:
    """Return by mode which inverse kinematics (`solver_of`) made the branch `combined` of the last report."""
    return {
        str(report.get("mode")): solver_of(report.get("settings") or {})
        for report in reports
        if COMBINED in report["mean"]
    }


def of_one_solver(reports: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return reports in which the branch `combined` of a mode is by one inverse kinematics only, the last.

    Reports with another lose that branch, so that joined results never mix two.
    """
    last = combined_by(reports)

    def fits(report: Mapping[str, Any]) -> bool:
        return solver_of(report.get("settings") or {}) == last.get(str(report.get("mode")))

    return [dict(report) if fits(report) else _without_combined(report) for report in reports]


def _without_combined(report: Mapping[str, Any]) -> dict[str, Any]:
    mean, *clips = (
        {branch: errors for branch, errors in row.items() if branch != COMBINED}
        for row in (report["mean"], *report.get("clips", ()))
    )
    return {**report, "mean": mean, "clips": clips}


def with_solvers(results: Mapping[str, Any], by: Mapping[str, str | None]) -> dict[str, Any]:
    """Return results with the inverse kinematics in the name of the branch `combined`: "combined-lbfgs-15".

    Args:
        results: by mode and branch; what else is in them stays.
        by: the inverse kinematics by mode (`combined_by`).
    """

    def named(mode: str, branch: str) -> str:
        return f"{branch}-{by[mode]}" if branch == COMBINED and by.get(mode) else branch

    return {
        mode: {named(mode, branch): errors for branch, errors in branches.items()}
        if isinstance(branches, Mapping)
        else branches
        for mode, branches in results.items()
    }


def _content_digest(content: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]
