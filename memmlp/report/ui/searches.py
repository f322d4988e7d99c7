"""The answers about searches: trials with values and parameters, importance, Pareto front."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from memmlp.common.errors import InputError
from memmlp.common.files import read_json

if TYPE_CHECKING:
    import optuna
    from optuna.trial import FrozenTrial


class Searches:
    """The searches below an outputs folder.

    A search is read again when its journal has grown. One in a storage of the user's is read again after its
    controller's last sign of life.
    """

    def __init__(self, outputs: Path):
        self.outputs = outputs
        self.pages: dict[str, tuple[int, dict[str, Any]]] = {}

    def names(self) -> list[str]:
        """Return the names of the searches' folders, the most recently changed first."""
        stamps = {path.name: _changed(path) for path in self.outputs.glob("tune/*/")}
        return sorted(filter(stamps.get, stamps), key=lambda name: -stamps[name])

    def stamp(self) -> str:
        """Return a text that changes when any search changes."""
        return repr([(name, _changed(self.outputs / "tune" / name)) for name in self.names()])

    def runs(self) -> Iterator[tuple[str, int, str]]:
        """Yield a search's name, a trial's number and the id of one of its runs, for all of them."""
        for name in self.names():
            for trial in self.describe(name).get("trials", ()):
                for run_id in trial["runs"]:
                    yield name, trial["number"], run_id

    def list_rows(self) -> dict[str, Any]:
        """Return a row for each search; the row of an unreadable one has an `error`."""
        keys = ("name", "title", "error", "objectives", "wanted", "counts", "best")
        pages = map(self.describe, self.names())
        return {"searches": [{key: page.get(key) for key in keys} for page in pages]}

    def describe(self, name: str) -> dict[str, Any]:
        """Return everything that a search's page shows. Raises KeyError for an unknown search."""
        if name not in self.names():
            raise KeyError(name)
        folder = self.outputs / "tune" / name
        stamp, known = _changed(folder), self.pages.get(name)
        if known is None or known[0] != stamp:
            known = self.pages[name] = (stamp, _describe(folder))
        return known[1]


def _changed(folder: Path) -> int:
    """Return when a search last changed, in nanoseconds; 0 if the folder does not hold a search."""
    journal = folder / "study.journal"
    signs = [journal] if journal.exists() else folder.glob("controllers/*.json")
    times = [0]
    for file in (folder / "search.json", *signs):
        try:
            times.append(file.stat().st_mtime_ns)
        except OSError:
            continue
    return max(times)


def _describe(folder: Path) -> dict[str, Any]:
    import optuna

    from memmlp.sweep.search.study import open_storage

    spec = read_json(folder / "search.json")
    title = str(spec.get("name") or folder.name)
    about = {"name": folder.name, "title": title, "wanted": spec.get("n_trials")}
    try:
        storage = open_storage(spec.get("storage"), folder)
        return about | _describe_study(optuna.load_study(storage=storage, study_name=folder.name))
    except KeyError:
        return {**about, "error": "has not started"}
    except (InputError, ValueError, TypeError) as error:
        return {**about, "error": " ".join(str(error).split())[:300]}


def _describe_study(study: optuna.Study) -> dict[str, Any]:
    from optuna.trial import TrialState

    from memmlp.sweep.search.results import IMPORTANCE, boundary_warnings, importances, too_few_trials

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
        "ends": boundary_warnings(study),
        "importance_is": IMPORTANCE,
        "too_few": too_few_trials(study),
        "importance": [[key, round(share, 4)] for key, share in importances(study)],
    }


def _describe_trial(trial: FrozenTrial) -> dict[str, Any]:
    from optuna.trial import TrialState

    from memmlp.sweep.search.study import reason

    # Optuna gives a pruned trial the value of its last step, which is not a result.
    values = trial.values if trial.state == TrialState.COMPLETE else []
    return {
        "number": trial.number,
        "state": trial.state.name.lower(),
        "values": [value if math.isfinite(value) else None for value in values],
        "params": trial.params,
        "runs": list(trial.user_attrs.get("runs", ())),
        "reason": reason(trial),
    }
