"""The content of the pages of searches: trials with values and parameters, importance, Pareto front."""

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

MOST_STEPS = 60  # so many values of a trial's course are told at most


class Searches:
    """The searches below an outputs folder; each is read again when its journal has grown.

    One in a storage of the user's own is read again when its director has shown signs of life since.
    """

    def __init__(self, outputs: Path):
        self.outputs = outputs
        self.pages: dict[str, tuple[Any, dict[str, Any]]] = {}

    def names(self) -> list[str]:
        """Return the names of the searches' folders, the most recently changed first."""
        folders = [path for path in self.outputs.glob("tune/*/") if _stamp(path)]
        return [path.name for path in sorted(folders, key=_stamp, reverse=True)]

    def stamp(self) -> str:
        """Return a text that changes when any search changes."""
        return repr([(name, _stamp(self.outputs / "tune" / name)) for name in self.names()])

    def runs(self) -> Iterator[tuple[str, int, str]]:
        """Yield a search's name, a trial's number and the id of one of its runs, for all of them."""
        for name in self.names():
            for trial in self.page(name).get("trials", ()):
                for run_id in trial["runs"]:
                    yield name, trial["number"], run_id

    def rows(self) -> dict[str, Any]:
        """Return a row for each search; the row of one that can't be read says why."""
        found = []
        for name in self.names():
            page = self.page(name)
            found.append(
                {
                    key: page.get(key)
                    for key in ("name", "title", "error", "objectives", "wanted", "counts", "best")
                }
            )
        return {"searches": found}

    def page(self, name: str) -> dict[str, Any]:
        """Return everything that a search's page shows. Raises KeyError for an unknown search."""
        if name not in self.names():
            raise KeyError(name)
        folder = self.outputs / "tune" / name
        stamp = _stamp(folder)
        known = self.pages.get(name)
        if known is None or known[0] != stamp:
            known = (stamp, _page(folder))
            self.pages[name] = known
        return known[1]


def _stamp(folder: Path) -> int:
    """Return when a search last changed, in nanoseconds; 0 if the folder holds no search."""
    journal = folder / "study.journal"
    signs = [journal] if journal.exists() else folder.glob("controllers/*.json")
    times = []
    for file in (folder / "search.json", *signs):
        try:
            times.append(file.stat().st_mtime_ns)
        except OSError:
            continue
    return max(times, default=0)


def _page(folder: Path) -> dict[str, Any]:
    spec = read_json(folder / "search.json")
    about = {
        "name": folder.name,
        "title": str(spec.get("name") or folder.name),
        "wanted": spec.get("n_trials"),
    }
    try:
        return {**about, **_of_study(_study(folder, spec.get("storage")))}
    except KeyError:
        return {**about, "error": "not begun"}
    except (InputError, ValueError, TypeError) as error:
        return {**about, "error": " ".join(str(error).split())[:300]}


def _study(folder: Path, url: str | None) -> optuna.Study:
    import optuna

    from memmlp.sweep.search.study import open_storage

    return optuna.load_study(storage=open_storage(url, folder), study_name=folder.name)


def _of_study(study: optuna.Study) -> dict[str, Any]:
    from optuna.trial import TrialState

    from memmlp.sweep.search.results import IMPORTANCE, at_an_end, study_importances, too_few_trials

    trials = [trial for trial in study.get_trials(deepcopy=False) if trial.state != TrialState.WAITING]
    complete = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    objectives = study.metric_names or [f"objective {number + 1}" for number in range(len(study.directions))]
    front = [trial.number for trial in study.best_trials] if complete else []
    return {
        "objectives": objectives,
        "keys": list(dict.fromkeys(key for trial in trials for key in trial.params)),
        "log": sorted(
            {
                key
                for trial in trials
                for key, one in trial.distributions.items()
                if getattr(one, "log", False)
            }
        ),
        "counts": dict(Counter(trial.state.name.lower() for trial in trials)),
        "front": front,
        "best": [_trial(trial) for trial in complete if trial.number in front][:1],
        "trials": [_trial(trial) for trial in trials],
        "ends": at_an_end(study),
        "importance_is": IMPORTANCE,
        "too_few": too_few_trials(study),
        "importance": [[key, round(share, 4)] for key, share in study_importances(study)],
    }


def _trial(trial: FrozenTrial) -> dict[str, Any]:
    from optuna.trial import TrialState

    from memmlp.sweep.search.study import reason

    # Optuna gives a pruned trial the value of its last step, which is no result.
    values = trial.values if trial.state == TrialState.COMPLETE else []
    course = sorted(trial.intermediate_values.items())
    return {
        "number": trial.number,
        "state": trial.state.name.lower(),
        "values": [value if math.isfinite(value) else None for value in values],
        "params": trial.params,
        "runs": list(trial.user_attrs.get("runs", ())),
        "reason": reason(trial),
        "course": [
            [step, value]
            for step, value in course[:: max(len(course) // MOST_STEPS, 1)]
            if math.isfinite(value)
        ],
    }
