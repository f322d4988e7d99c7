"""A run's evaluations with the settings of its config, among all that are in its folder."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from memmlp.common.files import read_json, to_number
from memmlp.runs.evaluation_file import check_report, combined_by, of_one_solver, outdated_by, preference
from memmlp.runs.identity import used_as_configured


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
        for report in of_one_solver(self._reports()):
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
        last = {report.get("mode"): outdated_by(path, report) for path, report in self._found.items()}
        return {str(mode): changed for mode, changed in last.items() if changed}

    def _reports(self) -> list[dict[str, Any]]:
        """Return the reports. Raises InputError if one is damaged."""
        for path, report in self._found.items():
            check_report(path, report)
        return list(self._found.values())
