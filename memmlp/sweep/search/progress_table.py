"""The live table of a search: what runs, the best trials so far, and how many trials ended in each way."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

from optuna.trial import FrozenTrial, TrialState
from rich import box
from rich.console import Group
from rich.table import Table
from rich.text import Text

from memmlp.runs.run import Run
from memmlp.sweep.progress_table import Screen, device_name, devices, progress_text
from memmlp.sweep.search.search_file import Search, Value
from memmlp.sweep.search.study import Study, deviations, reason

SHOWN = 5  # how many of the best trials are shown
WORDS = {TrialState.COMPLETE: "complete", TrialState.PRUNED: "pruned", TrialState.FAIL: "failed"}


class SearchBoard(Screen):
    """Shows a search in progress.

    Args:
        outputs: the folder of runs and caches.
    """

    def __init__(self, outputs: Path):
        super().__init__()
        self.outputs = outputs
        self.told: set[int] | None = None

    def update(self, study: Study) -> None:
        """Show the study, and the runs of its trials, in their present state."""
        ended = [trial for trial in study.trials if trial.state in WORDS]
        told = {trial.number for trial in ended} if self.told is None else self.told
        new = [trial for trial in ended if trial.number not in told]
        self.show(
            lambda: render(study, self.outputs),
            [line(study.search, trial, len(ended), self.outputs) for trial in new],
            lambda: progress(study, self.outputs),
        )
        self.told = {trial.number for trial in ended}


def line(search: Search, trial: FrozenTrial, ended: int, outputs: Path) -> str:
    """Say how a trial ended, and on which devices its runs ran."""
    what = figures(trial) if trial.state == TrialState.COMPLETE else reason(trial)
    params = ", ".join(f"{key}={_value(value)}" for key, value in trial.params.items())
    names = ", ".join(dict.fromkeys(filter(None, map(device_name, runs_of(trial, outputs)))))
    how = f"{WORDS[trial.state]} on {names}" if names else WORDS[trial.state]
    return f"{ended} of {search.n_trials}; trial {trial.number} {how}: {what} ({params})"


def progress(study: Study, outputs: Path) -> list[str]:
    """Return a line about each trial of which a run is worked on, or one that none is yet."""
    going = [(trial, runs_of(trial, outputs)) for trial in study.trials if trial.state not in WORDS]
    lines = [
        f"trial {trial.number}: {_going(trial, runs)}"
        for trial, runs in going
        if any(run.doing for run in runs)
    ]
    ended = sum(trial.state in WORDS for trial in study.trials)
    return [f"{ended} of {study.search.n_trials}; {line}" for line in lines or ["workers are starting"]]


def runs_of(trial: FrozenTrial, outputs: Path) -> list[Run]:
    """Return the runs that a trial has needed so far."""
    return [Run.of(outputs, run_id) for run_id in trial.user_attrs.get("runs", ())]


def figures(trial: FrozenTrial) -> str:
    """Return a trial's objective values as text, with standard deviations if it has several seeds."""
    shown = [f"{value:.3f}" for value in trial.values or []]
    if spread := deviations(trial):
        shown = [f"{value} ± {sd:.3f}" for value, sd in zip(shown, spread, strict=True)]
    return ", ".join(shown)


def render(study: Study, outputs: Path) -> Group:
    """Draw the running trials, the best ones, the counts, and the devices in use."""
    table = trials_table(study.search, f"search {study.search.name}")
    going = [(trial, runs_of(trial, outputs)) for trial in study.trials if trial.state not in WORDS]
    for trial, runs in going:
        row(table, study.search, trial, _going(trial, runs))
    ranked = sorted((t for t in study.trials if t.state == TrialState.COMPLETE), key=lambda t: t.values)
    for trial in ranked[:SHOWN]:
        row(table, study.search, trial, Text(figures(trial), style="green"))
    running = (run for _, runs in going for run in runs if run.doing)
    return Group(table, Text(counts(study)), *map(Text, devices(running)))


def _going(trial: FrozenTrial, runs: Sequence[Run]) -> Text:
    """Describe the progress of a trial's runs."""
    going = next((run for run in runs if run.doing), None)
    count = sum(run.done for run in runs if run is not going)
    done = f"{count} seeds done, " if count else ""
    if going is None:
        return Text(f"{done}waiting")
    return Text(done + progress_text(going, trial.user_attrs["steps"]), style="cyan")


def trials_table(search: Search, title: str) -> Table:
    """Make an empty table of trials, with a column for each searched key."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, title=title, title_justify="left")
    table.add_column("trial", justify="right")
    table.add_column(", ".join(objective.text for objective in search.objectives))
    for name in short(one.key for one in search.space):
        table.add_column(name, justify="right")
    return table


def short(keys: Iterable[str]) -> list[str]:
    """Return the keys without their group, if all of them have the same group."""
    every = list(keys)
    groups = {key.rpartition(".")[0] for key in every}
    return [key.rpartition(".")[2] for key in every] if len(groups) == 1 else every


def row(table: Table, search: Search, trial: FrozenTrial, state: Text) -> None:
    """Add a trial's row to a table."""
    table.add_row(str(trial.number), state, *map(Text, _shown(search, trial)))


def _shown(search: Search, trial: FrozenTrial) -> Iterable[str]:
    for one in search.space:
        yield _value(trial.params.get(one.key, ""))


def _value(value: Value) -> str:
    """Return a value that a trial has for a key as a short text."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def counts(study: Study) -> str:
    """Say how many trials are in each state, and how many are wanted."""
    found = Counter(WORDS.get(trial.state, "running") for trial in study.trials)
    listed = ", ".join(f"{count} {state}" for state, count in found.items())
    return f"{len(study.trials)} of {study.search.n_trials} trials: {listed or 'none yet'}"
