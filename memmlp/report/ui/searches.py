"""The server's answers about searches: trials, parameter importance, Pareto front."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from memmlp.common.errors import InputError
from memmlp.report.ui.run_index import get_change_time
from memmlp.runs import records
from memmlp.runs.records import SearchRecord

if TYPE_CHECKING:
    import optuna
    from optuna.trial import FrozenTrial

SQLITE = "sqlite:///"


class Searches:
    """The searches in an outputs folder.

    A search is read again when its journal changes. A search in a custom storage is read again when its
    controller writes a sign of life.
    """

    def __init__(self, outputs: Path):
        self.outputs = outputs
        self.pages: dict[str, tuple[int, dict[str, Any]]] = {}

    def list_names(self) -> list[str]:
        """Return the folder names of the searches, the last changed first."""
        stamps = {path.name: _find_change_time(path) for path in self.outputs.glob("tune/*/")}
        return sorted(filter(stamps.get, stamps), key=lambda name: -stamps[name])

    def make_change_stamp(self) -> str:
        """Return a text that changes when any search changes."""
        return repr([(name, _find_change_time(self.outputs / "tune" / name)) for name in self.list_names()])

    def list_runs(self) -> Iterator[tuple[str, int, str]]:
        """Yield search name, trial number and run id for each run of each trial."""
        for name in self.list_names():
            for trial in self.describe(name).get("trials", ()):
                for run_id in trial["runs"]:
                    yield name, trial["number"], run_id

    def list_rows(self) -> dict[str, Any]:
        """Return a row for each search; an unreadable search has an `error`."""
        keys = ("name", "title", "error", "objectives", "wanted", "counts", "best")
        pages = map(self.describe, self.list_names())
        return {"searches": [{key: page.get(key) for key in keys} for page in pages]}

    def describe(self, name: str) -> dict[str, Any]:
        """Return the content of a search's page. Raises KeyError for an unknown search."""
        if name not in self.list_names():
            raise KeyError(name)
        folder = self.outputs / "tune" / name
        stamp, page = _find_change_time(folder), self.pages.get(name)
        if page is None or page[0] != stamp:
            page = self.pages[name] = (stamp, _describe_search(folder))
        return page[1]


def _find_change_time(folder: Path) -> int:
    """Return the time of a search's last change, nanoseconds; 0 if the folder does not contain a search."""
    journal = folder / "study.journal"
    signs = [journal] if journal.exists() else folder.glob("controllers/*.json")
    return max(map(get_change_time, (folder / "search.json", *signs)))


def _describe_search(folder: Path) -> dict[str, Any]:
    import optuna

    from memmlp.sweep.search.study import open_storage

    spec = records.read(folder / "search.json", SearchRecord)
    damage = records.find_damage(folder / "search.json", SearchRecord)
    title = spec.get("name") or folder.name
    about = {"name": folder.name, "title": title, "wanted": spec.get("n_trials")}
    url = str(spec.get("storage") or "")
    if damage or (url.startswith(SQLITE) and not Path(url.removeprefix(SQLITE)).is_file()):
        return {**about, "error": damage or "has not started"}  # opening would make the file
    try:
        storage = open_storage(url or None, folder)
        return about | _describe_study(optuna.load_study(storage=storage, study_name=folder.name))
    except KeyError:
        return {**about, "error": "has not started"}
    except (InputError, ValueError, TypeError) as error:
        return {**about, "error": " ".join(str(error).split())[:300]}


def _describe_study(study: optuna.Study) -> dict[str, Any]:
    from optuna.trial import TrialState

    from memmlp.sweep.search.results import (
        IMPORTANCE,
        compute_importances,
        explain_missing_importances,
        find_boundary_warnings,
    )

    trials = [trial for trial in study.get_trials(deepcopy=False) if trial.state != TrialState.WAITING]
    complete = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    front = [trial.number for trial in study.best_trials] if complete else []
    logarithmic = {
        key for trial in trials for key, one in trial.distributions.items() if getattr(one, "log", False)
    }
    return {
        "objectives": study.metric_names or [f"objective {n + 1}" for n in range(len(study.directions))],
        "keys": list(dict.fromkeys(key for trial in trials for key in trial.params)),
        "log": sorted(logarithmic),
        "counts": dict(Counter(trial.state.name.lower() for trial in trials)),
        "front": front,
        "best": [_describe_trial(trial) for trial in complete if trial.number in front][:1],
        "trials": [_describe_trial(trial) for trial in trials],
        "ends": find_boundary_warnings(study),
        "importance_is": IMPORTANCE,
        "too_few": explain_missing_importances(study),
        "importance": [[key, round(share, 4)] for key, share in compute_importances(study)],
    }


def _describe_trial(trial: FrozenTrial) -> dict[str, Any]:
    from optuna.trial import TrialState

    from memmlp.sweep.search.study import get_reason

    # For a pruned trial, Optuna has the value of the last step, which is not a result.
    values = trial.values if trial.state == TrialState.COMPLETE else []
    return {
        "number": trial.number,
        "state": trial.state.name.lower(),
        "values": [value if math.isfinite(value) else None for value in values],
        "params": trial.params,
        "began": trial.datetime_start.timestamp() if trial.datetime_start else None,
        "ended": trial.datetime_complete.timestamp() if trial.datetime_complete else None,
        "runs": list(trial.user_attrs.get("runs", ())),
        "reason": get_reason(trial),
    }
