"""Evaluation files; each contains its own digest."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from memmlp.common.errors import InputError
from memmlp.common.files import make_json_safe, now, to_number, write_json
from memmlp.runs import records
from memmlp.runs.environment import describe_environment
from memmlp.runs.identity import (
    belongs_to_folder,
    find_version,
    get_solver_name,
    has_configured_inference,
    hash_evaluation_settings,
    list_outdated,
)

COMBINED = "combined"
"""The branch with rotations after inverse kinematics; the evaluation's settings name the solver."""


def write_report(path: Path, report: Mapping[str, Any]) -> None:
    """Write an evaluation file: the report with time, environment and a digest."""
    path.parent.mkdir(parents=True, exist_ok=True)
    content = make_json_safe({**report, "made": now(), "made_by": describe_environment()})
    write_json(path, content | {"digest": records.compute_digest(content)})


def read_report(path: Path) -> dict[str, Any]:
    """Read an evaluation file. Raises InputError if it is damaged."""
    if report := records.load(path, records.Evaluation):
        return report
    raise InputError(f"{path}: missing; repeat the run's command to evaluate again")


def is_intact(path: Path) -> bool:
    """Return whether an evaluation file is unchanged and has its original name and folder."""
    content = records.read(path, records.Evaluation)
    same = content.get("digest") == records.compute_digest(content)
    named = content.get("name", path.stem) == path.stem
    return same and named and belongs_to_folder(content.get("run"), path.parent.parent)


def is_current(path: Path, report: Mapping[str, Any]) -> bool:
    """Return whether an evaluation used the current component versions."""
    settings = report.get("settings") or {}
    return {"mode", "ik"} <= settings.keys() and path.stem == hash_evaluation_settings(settings)


def describe_outdated(report: Mapping[str, Any]) -> str | None:
    """Return the changed component versions of an evaluation, such as "mode.window 2 -> 3", or None."""
    recorded = report.get("component_versions") or {}
    comparable = {name: number for name, number in recorded.items() if find_version(name)}
    return ", ".join(list_outdated(comparable)) or None


def make_preference_key(
    path: Path, report: Mapping[str, Any], config: Mapping[str, Any]
) -> tuple[bool, bool, str]:
    """Return a sort key for a run's evaluations; the preferred one comes last: by current component versions,
    then by the inverse kinematics in the run's config, then by time."""
    settings = report.get("settings") or {}
    configured = get_solver_name(settings) == get_solver_name(config.get("evaluation") or {})
    return is_current(path, report), configured, str(report.get("made"))


def find_combined_solvers(reports: Sequence[Mapping[str, Any]]) -> dict[str, str | None]:
    """Return the solver (`get_solver_name`) of each mode's branch `combined`, from the last report."""
    return {
        str(report.get("mode")): get_solver_name(report.get("settings") or {})
        for report in reports
        if COMBINED in report["mean"]
    }


def keep_one_solver(reports: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Remove the branch `combined` where its inverse kinematics differs from the mode's last report."""
    last, kept = find_combined_solvers(reports), []
    for report in reports:
        rows = [report["mean"], *report.get("clips", ())]
        if get_solver_name(report.get("settings") or {}) != last.get(str(report.get("mode"))):
            rows = [{key: errors for key, errors in row.items() if key != COMBINED} for row in rows]
        kept.append({**report, "mean": rows[0], "clips": rows[1:]})
    return kept


def add_solver_names(results: Mapping[str, Any], solvers: Mapping[str, str | None]) -> dict[str, Any]:
    """Add the solver's name, by mode, to the branch `combined`: "combined-lbfgs-15"."""
    named = dict(results)
    for mode, solver in solvers.items():
        if solver and isinstance(branches := results.get(mode), Mapping):
            renamed = {COMBINED: f"{COMBINED}-{solver}"}
            named[mode] = {renamed.get(branch, branch): errors for branch, errors in branches.items()}
    return named


class ConfiguredEvaluations:
    """A run's evaluations that match its config. The preferred path is last (`make_preference_key`)."""

    def __init__(self, folder: Path, config: Mapping[str, Any]):
        every = {path: records.read(path, records.Evaluation) for path in sorted(folder.glob("*.json"))}
        matching = [
            (path, one)
            for path, one in every.items()
            if not one or has_configured_inference(one.get("settings") or {}, config)
        ]
        self._matching = dict(sorted(matching, key=lambda one: make_preference_key(one[0], one[1], config)))
        self.paths = list(self._matching)

    @property
    def results(self) -> dict[str, dict[str, dict[str, float | None]]]:
        """The mean errors, by mode, branch and metric. Raises InputError if a file is damaged."""
        results: dict[str, dict[str, dict[str, float | None]]] = {}
        for report in keep_one_solver(self._read_reports()):
            branches = results.setdefault(report["mode"], {})
            for branch, errors in report["mean"].items():  # a custom metric may exist in one branch only
                numbers = {name: to_number(value) for name, value in errors.items()}
                branches[branch] = {**branches.get(branch, {}), **numbers}
        return results

    @property
    def combined_solvers(self) -> dict[str, str | None]:
        """The inverse kinematics of the branch `combined`, by mode. Raises InputError if a file is
        damaged."""
        return find_combined_solvers(self._read_reports())

    @property
    def outdated(self) -> dict[str, str]:
        """The changed component versions, by mode; modes with current versions are left out."""
        last = {report.get("mode"): describe_outdated(report) for report in self._matching.values()}
        return {str(mode): changed for mode, changed in last.items() if changed}

    def _read_reports(self) -> list[dict[str, Any]]:
        return list(map(read_report, self._matching))
