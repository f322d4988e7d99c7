"""The files of evaluations; each contains its own digest."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from memmlp.common.errors import InputError
from memmlp.common.files import now, plain, read_json, to_number, write_json
from memmlp.runs.environment import environment
from memmlp.runs.identity import (
    belongs,
    evaluation_id_of,
    outdated,
    solver_of,
    used_as_configured,
    version_of,
)

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


def describe_outdated(path: Path, report: Mapping[str, Any]) -> str | None:
    """Return which components of an evaluation have changed since, as "mode.window 2 -> 3"; None if none has.

    Custom metrics of packages that are not in use are not compared.
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


def keep_one_solver(reports: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
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


def name_solvers(results: Mapping[str, Any], by: Mapping[str, str | None]) -> dict[str, Any]:
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


class EvaluationsAsConfigured:
    """The evaluations with the settings of a run's config.

    Attributes:
        paths: their files, the one that counts last (`preference`).
    """

    def __init__(self, folder: Path, config: Mapping[str, Any]):
        """Read the evaluations of a folder that match the config.

        Args:
            folder: the run's folder of evaluations.
            config: the run's config.
        """
        every = {path: read_json(path) for path in sorted(folder.glob("*.json"))}
        own = [
            (path, one) for path, one in every.items() if used_as_configured(one.get("settings", {}), config)
        ]
        self._found = dict(sorted(own, key=lambda one: preference(one[0], one[1], config)))
        self.paths = list(self._found)

    @property
    def results(self) -> dict[str, dict[str, dict[str, float | None]]]:
        """The mean errors, by mode, branch and metric; `combined` is by one kind of inverse kinematics.

        Raises:
            InputError: if a file is damaged.
        """
        found: dict[str, dict[str, dict[str, float | None]]] = {}
        for report in keep_one_solver(self._reports()):
            branches = found.setdefault(report["mode"], {})
            for branch, errors in report["mean"].items():  # custom metrics may be in one branch only
                numbers = {name: to_number(value) for name, value in errors.items()}
                branches[branch] = {**branches.get(branch, {}), **numbers}
        return found

    @property
    def combined_by(self) -> dict[str, str | None]:
        """The inverse kinematics of the branch `combined` in `results`, by mode: "arms", "lbfgs-15".

        It is None where that is not known. Raises InputError as `results` does.
        """
        return combined_by(self._reports())

    @property
    def outdated(self) -> dict[str, str]:
        """The changed component versions of each mode whose `results` were measured with earlier ones."""
        last = {report.get("mode"): describe_outdated(path, report) for path, report in self._found.items()}
        return {str(mode): changed for mode, changed in last.items() if changed}

    def _reports(self) -> list[dict[str, Any]]:
        """Return the reports. Raises InputError if one is damaged."""
        for path, report in self._found.items():
            check_report(path, report)
        return list(self._found.values())
