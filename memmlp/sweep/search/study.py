"""The Optuna study of a search. A single process owns it, which asks for trials and records their results.

A trial has these user attributes. "runs": the ids of its runs, one for each requested seed. "values": the
objectives of each seed; the trial's values are the means over seeds. "reason": why the trial failed. If the
owner is killed, the next owner continues the running trials with the same numbers.
"""

from __future__ import annotations

import json
import math
import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import optuna
from optuna.exceptions import ExperimentalWarning
from optuna.storages import BaseStorage, JournalStorage, get_storage
from optuna.storages.journal import JournalFileBackend
from optuna.study import StudyDirection
from optuna.trial import FrozenTrial, Trial, TrialState

from memmlp.common.errors import InputError
from memmlp.common.files import atomic_write, naming_file
from memmlp.common.lease import check_owner
from memmlp.sweep.search.search_file import Range, Search, Value

LINE_START = b'{"op_code":'  # the start of every line of a journal


class Study:
    """The trials of a search, in a persistent storage."""

    def __init__(self, search: Search, study: optuna.Study):
        self.search, self.study = search, study

    @classmethod
    def open(cls, search: Search, name: str, folder: Path) -> Study:
        """Open or create the study with this name. The calling process becomes its only owner. Without a
        storage URL, the study is a journal in the folder. Raises InputError if the storage cannot be opened.
        """
        if search.storage is None:
            repair_journal(journal_path(folder))
        after = search.prune_after
        pruner = optuna.pruners.NopPruner() if after is None else optuna.pruners.MedianPruner(after, 0)
        storage = open_storage(search.storage, folder)
        try:
            study = optuna.load_study(storage=storage, study_name=name, pruner=pruner)
        except KeyError:
            goals = [StudyDirection.MINIMIZE] * len(search.objectives)
            study = optuna.create_study(storage=storage, study_name=name, pruner=pruner, directions=goals)
        if study.metric_names is None:
            with warnings.catch_warnings(action="ignore", category=ExperimentalWarning):
                study.set_metric_names([objective.text for objective in search.objectives])
        for values in search.list_first_trials():
            study.enqueue_trial(values, skip_if_exists=True)
        return cls(search, study)

    @classmethod
    def view(cls, search: Search, name: str, folder: Path) -> Study | None:
        """Open the study for reading, also while its owner works. Return None if it does not exist."""
        if search.storage is None and not journal_path(folder).exists():
            return None
        try:
            storage = open_storage(search.storage, folder)
            return cls(search, optuna.load_study(storage=storage, study_name=name))
        except KeyError:
            return None

    @property
    def trials(self) -> list[FrozenTrial]:
        """All started trials, ordered by number."""
        trials = self.study.get_trials(deepcopy=False)
        return [trial for trial in trials if trial.state != TrialState.WAITING]

    def list_running(self) -> Iterator[Trial]:
        """Yield the running trials. Values that are missing, because the last owner was killed while it
        suggested them, are suggested first."""
        for trial in self.trials:
            if trial.state == TrialState.RUNNING:
                self.study.sampler = make_sampler(self.search, trial.number)
                yield self._suggest_values(Trial(self.study, trial._trial_id))

    @property
    def is_full(self) -> bool:
        return len(self.trials) >= self.search.n_trials

    def ask(self) -> Trial:
        self.study.sampler = make_sampler(self.search, len(self.trials))
        return self._suggest_values(self.study.ask())

    def _suggest_values(self, trial: Trial) -> Trial:
        for index, one in enumerate(self.search.space, 1):
            self.study.sampler = make_sampler(self.search, trial.number, index)
            suggest_value(trial, one)
        return trial

    def prune(self, trial: Trial) -> bool:
        """End the trial if the pruner decides so, and return whether it was ended."""
        if self.search.pruner == "none" or not trial.should_prune():
            return False
        self.study.tell(trial.number, state=TrialState.PRUNED)
        return True

    def complete(self, trial: Trial, values: Sequence[Sequence[float]]) -> None:
        """End the trial with each objective's mean over seeds, given each seed's objectives. The trial fails
        if a mean is NaN."""
        trial.set_user_attr("values", [list(seed) for seed in values])
        means = [fmean(objective) for objective in zip(*values, strict=True)]
        named = zip(self.search.objectives, means, strict=True)
        if names := [objective.text for objective, mean in named if math.isnan(mean)]:
            trial.set_user_attr("reason", f"{' and '.join(names)} is NaN")
        with warnings.catch_warnings(action="ignore"):
            self.study.tell(trial.number, means, skip_if_finished=True)

    def fail(self, trial: Trial, reason: str) -> None:
        trial.set_user_attr("reason", reason)
        self.study.tell(trial.number, state=TrialState.FAIL, skip_if_finished=True)

    def list_best(self) -> list[FrozenTrial]:
        """Return the best trial, or with two objectives the Pareto front sorted by the first objective."""
        if all(trial.state != TrialState.COMPLETE for trial in self.trials):
            return []
        if len(self.search.objectives) == 1:
            return [self.study.best_trial]
        return sorted(self.study.best_trials, key=lambda trial: trial.values)


class FencedJournal(JournalFileBackend):
    """A journal without a lock file, because only the current owner of its folder appends to it."""

    def __init__(self, path: Path):
        super().__init__(str(path))
        self.path = path

    def append_logs(self, logs: list[dict[str, Any]]) -> None:
        """Append lines to the journal. Raises LeaseLost if another process now owns its folder."""
        lines = "".join(json.dumps(log, separators=(",", ":")) + "\n" for log in logs)
        with naming_file(self.path), open(self.path, "ab") as file:
            check_owner(self.path)  # after opening, because `repair_journal` of a later owner replaces it
            file.write(lines.encode())
            file.flush()
            os.fsync(file.fileno())


def open_storage(url: str | None, folder: Path) -> BaseStorage:
    """Open the storage at a URL, or the journal in a folder if the URL is None. Raises InputError for an
    invalid URL or a damaged journal."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    if url:
        try:
            return get_storage(url)
        except Exception as error:
            reason = " ".join(str(error).split())[:200]
            raise InputError(f"search.storage={url}: {reason}") from None
    path = journal_path(folder)
    check_journal(path)
    try:
        with warnings.catch_warnings(action="ignore", category=ExperimentalWarning):
            return JournalStorage(FencedJournal(path))
    except (ValueError, KeyError, TypeError) as error:
        raise _make_damage_error(path, error) from None


def journal_path(folder: Path) -> Path:
    """Return the path of the journal in a search's folder. `optuna-dashboard` can read the file."""
    return folder / "study.journal"


def repair_journal(path: Path) -> None:
    """Replace a journal by a copy without an incomplete last line, which a killed process may leave; Optuna
    cannot read lines after it. Only the owner may call this. An earlier owner that resumes after a freeze
    appends to the replaced file, so it does not change the copy."""
    check_journal(path)
    if path.exists():
        content = path.read_bytes()
        atomic_write(path, content[: content.rfind(b"\n") + 1])


def check_journal(path: Path) -> None:
    """Raise InputError for a file that is not a journal. Optuna would read it as an empty journal."""
    if path.exists():
        with open(path, "rb") as file:
            begins = file.read(len(LINE_START))
        if not LINE_START.startswith(begins):
            raise _make_damage_error(path, "unknown first line")


def _make_damage_error(path: Path, reason: object) -> InputError:
    return InputError(f"{path}: must be an Optuna journal ({reason}); move it away to restart the search")


def make_sampler(search: Search, number: int, key: int = 0) -> optuna.samplers.BaseSampler:
    """Return the sampler of a trial, or of one of its keys, seeded with the search's seed and both numbers.
    So random values are the same if the search is killed at any moment and resumed, even within a trial."""
    seed = int(np.random.SeedSequence([search.seed, number, key]).generate_state(1)[0])
    if search.startup is None or search.sampler != "tpe":  # the trials of a grid already have values
        return optuna.samplers.RandomSampler(seed=seed)
    with warnings.catch_warnings(action="ignore", category=ExperimentalWarning):
        return optuna.samplers.TPESampler(
            seed=seed, n_startup_trials=search.startup, multivariate=True, constant_liar=True
        )


def suggest_value(trial: Trial, one: Range) -> Value:
    """Return a trial's value for a range's key; Optuna chooses it on the first call."""
    if one.choices:
        return trial.suggest_categorical(one.key, one.choices)
    if isinstance(one.low, int) and isinstance(one.high, int):
        return trial.suggest_int(one.key, one.low, one.high, step=int(one.step or 1), log=one.log)
    return trial.suggest_float(one.key, one.low, one.high, step=one.step, log=one.log)


def get_reason(trial: FrozenTrial) -> str:
    """Return why a trial failed, or the value and the step at which it was pruned; else an empty text."""
    if trial.state == TrialState.PRUNED and trial.values:
        return f"{trial.values[0]:.4g} at step {trial.last_step}"
    return str(trial.user_attrs.get("reason", ""))


def compute_deviations(trial: FrozenTrial) -> list[float]:
    """Return each objective's standard deviation over seeds; an empty list with fewer than two seeds."""
    by_seed = trial.user_attrs.get("values", [])
    return np.std(by_seed, axis=0, ddof=1).tolist() if len(by_seed) > 1 else []


def get_values(trial: FrozenTrial | Trial, search: Search) -> Mapping[str, Value]:
    """Return a trial's values by config key, in the order of `search.space`."""
    return {one.key: trial.params[one.key] for one in search.space}
