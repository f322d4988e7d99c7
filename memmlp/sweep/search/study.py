"""The Optuna study of a search. A single process owns it: it asks for trials and records how they ended.

A trial has these user attributes: "runs" are the ids of its runs so far, one for each seed; "values" are each
seed's objectives, whose means over seeds are the trial's own values; "reason" says why it failed. Whenever
the owner is killed, the next owner finds every trial either ended or running, and continues the running ones
under their numbers.
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
from memmlp.common.files import atomic_write
from memmlp.common.lease import check_owner
from memmlp.sweep.search.search_file import Range, Search, Value

BEGINNING = b'{"op_code":'  # how every line of a journal begins


class Study:
    """The trials of a search, in a storage that outlives its owner."""

    def __init__(self, search: Search, study: optuna.Study):
        self.search, self.study = search, study

    @classmethod
    def open(cls, search: Search, name: str, folder: Path) -> Study:
        """Return the study with that name, new or as it was left, for its only owner.

        Args:
            search: the search.
            name: the study's name in the storage.
            folder: the folder of the journal, if the search names no storage.

        Raises:
            InputError: if the storage can't be opened.
        """
        if search.storage is None:
            repair_journal(journal_path(folder))
        after = search.prune_after
        pruner = optuna.pruners.NopPruner() if after is None else optuna.pruners.MedianPruner(after, 0)
        settings: dict[str, Any] = {
            "storage": open_storage(search.storage, folder), "study_name": name, "pruner": pruner
        }  # fmt: skip
        try:
            study = optuna.load_study(**settings)
        except KeyError:
            minimize = [StudyDirection.MINIMIZE] * len(search.objectives)
            study = optuna.create_study(**settings, directions=minimize)
        if study.metric_names is None:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", ExperimentalWarning)
                study.set_metric_names([objective.text for objective in search.objectives])
        for values in search.first_trials():
            study.enqueue_trial(values, skip_if_exists=True)
        return cls(search, study)

    @classmethod
    def view(cls, search: Search, name: str, folder: Path) -> Study | None:
        """Return the study for reading while its owner works; None if it does not exist yet."""
        if search.storage is None and not journal_path(folder).exists():
            return None
        try:
            storage = open_storage(search.storage, folder)
            return cls(search, optuna.load_study(storage=storage, study_name=name))
        except KeyError:
            return None

    @property
    def trials(self) -> list[FrozenTrial]:
        """All trials that were asked for, ordered by number."""
        trials = self.study.get_trials(deepcopy=False)
        return [trial for trial in trials if trial.state != TrialState.WAITING]

    def running(self) -> Iterator[Trial]:
        """Yield the trials that have not ended, each with all its values.

        Their last owner may have been killed before they had all of them.
        """
        for trial in self.trials:
            if trial.state == TrialState.RUNNING:
                self.study.sampler = sampler(self.search, trial.number)
                yield self._suggest(Trial(self.study, trial._trial_id))

    @property
    def full(self) -> bool:
        """Whether there are as many trials as the search wants."""
        return len(self.trials) >= self.search.n_trials

    def ask(self) -> Trial:
        """Return a new trial."""
        self.study.sampler = sampler(self.search, len(self.trials))
        return self._suggest(self.study.ask())

    def _suggest(self, trial: Trial) -> Trial:
        for one in self.search.space:
            suggest(trial, one)
        return trial

    def prune(self, trial: Trial) -> bool:
        """End the trial if other trials were better at its step, and return whether it was ended."""
        if self.search.pruner == "none" or not trial.should_prune():
            return False
        self.study.tell(trial.number, state=TrialState.PRUNED)
        return True

    def complete(self, trial: Trial, values: Sequence[Sequence[float]]) -> None:
        """End the trial with its objectives' means over seeds. A mean that is NaN makes the trial a failure.

        `values` has a list for each seed, with the value of each objective.
        """
        trial.set_user_attr("values", [list(seed) for seed in values])
        means = [fmean(of_seeds) for of_seeds in zip(*values, strict=True)]
        names = [
            one.text for one, mean in zip(self.search.objectives, means, strict=True) if math.isnan(mean)
        ]
        if names:
            trial.set_user_attr("reason", f"{' and '.join(names)} is NaN")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            self.study.tell(trial.number, means, skip_if_finished=True)

    def fail(self, trial: Trial, reason: str) -> None:
        """End the trial as failed, without values."""
        trial.set_user_attr("reason", reason)
        self.study.tell(trial.number, state=TrialState.FAIL, skip_if_finished=True)

    def best(self) -> list[FrozenTrial]:
        """Return the best trial; with two objectives the Pareto front, sorted by the first objective."""
        if all(trial.state != TrialState.COMPLETE for trial in self.trials):
            return []
        if len(self.search.objectives) == 1:
            return [self.study.best_trial]
        return sorted(self.study.best_trials, key=lambda trial: trial.values)


class FencedJournal(JournalFileBackend):
    """A journal that needs no lock, since only its folder's present owner appends to it."""

    def __init__(self, path: Path):
        super().__init__(str(path))
        self.path = path

    def append_logs(self, logs: list[dict[str, Any]]) -> None:
        """Append lines to the journal. Raises LeaseLost if its folder has another owner now."""
        lines = "".join(json.dumps(log, separators=(",", ":")) + "\n" for log in logs)
        with open(self.path, "ab") as file:
            check_owner(self.path)  # after opening: `repair_journal` gave a later owner another file
            file.write(lines.encode())
            file.flush()
            os.fsync(file.fileno())


def open_storage(url: str | None, folder: Path) -> BaseStorage:
    """Return the storage of a URL, or for None the journal in a folder.

    Raises:
        InputError: for a bad URL or a damaged journal.
    """
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
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ExperimentalWarning)
            return JournalStorage(FencedJournal(path))
    except (ValueError, KeyError, TypeError) as error:
        raise _damaged(path, error) from None


def journal_path(folder: Path) -> Path:
    """Return the journal file of a search's study, which `optuna-dashboard` can read."""
    return folder / "study.journal"


def repair_journal(path: Path) -> None:
    """Replace a journal by a copy without an incomplete last line, which a killed process may leave.

    Only for the owner. Optuna takes a line that is appended to an incomplete one for damage. If an earlier
    owner was frozen and wakes up, it appends to the file that it has open, which is no longer this one, so it
    changes nothing.
    """
    check_journal(path)
    if path.exists():
        content = path.read_bytes()
        atomic_write(path, content[: content.rfind(b"\n") + 1])


def check_journal(path: Path) -> None:
    """Raise InputError for a file that is not a journal, which Optuna would take for an empty one."""
    if path.exists():
        with open(path, "rb") as file:
            begins = file.read(len(BEGINNING))
        if not BEGINNING.startswith(begins):
            raise _damaged(path, "it does not begin like one")


def _damaged(path: Path, reason: object) -> InputError:
    return InputError(f"{path}: not a journal of Optuna's ({reason}); move it away to restart the search")


def sampler(search: Search, number: int) -> optuna.samplers.BaseSampler:
    """Return the sampler of one trial, seeded by the search and the trial's number.

    So a resumed search does not repeat the random numbers of its earlier trials.
    """
    seed = int(np.random.SeedSequence([search.seed, number]).generate_state(1)[0])
    if search.startup is None or search.sampler != "tpe":  # a grid's trials have their values already
        return optuna.samplers.RandomSampler(seed=seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ExperimentalWarning)
        return optuna.samplers.TPESampler(
            seed=seed, n_startup_trials=search.startup, multivariate=True, constant_liar=True
        )


def suggest(trial: Trial, one: Range) -> Value:
    """Return a trial's value for a key: its existing value, or a new one."""
    if one.choices:
        return trial.suggest_categorical(one.key, one.choices)
    if isinstance(one.low, int) and isinstance(one.high, int):
        return trial.suggest_int(one.key, one.low, one.high, step=int(one.step or 1), log=one.log)
    return trial.suggest_float(one.key, one.low, one.high, step=one.step, log=one.log)


def reason(trial: FrozenTrial) -> str:
    """Return why a trial failed, or at which step and with what value it was pruned; else nothing."""
    if trial.state == TrialState.PRUNED and trial.values:
        return f"{trial.values[0]:.4g} at step {trial.last_step}"
    return str(trial.user_attrs.get("reason", ""))


def deviations(trial: FrozenTrial) -> list[float]:
    """Return each objective's standard deviation over seeds; empty with fewer than two seeds."""
    by_seed = trial.user_attrs.get("values", [])
    return np.std(by_seed, axis=0, ddof=1).tolist() if len(by_seed) > 1 else []


def trial_values(trial: FrozenTrial | Trial, search: Search) -> Mapping[str, Value]:
    """Return a trial's values by config key, in the order of the search's space."""
    return {one.key: trial.params[one.key] for one in search.space}
