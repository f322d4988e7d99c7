"""The live table of a search: what runs, the best trials so far, and how many trials ended in each way."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

from optuna.trial import FrozenTrial, TrialState
from rich.console import Group
from rich.table import Table
from rich.text import Text

from memmlp.runs.run import Run
from memmlp.sweep.progress_table import Screen, progress_text, titled_table
from memmlp.sweep.search.search_file import Search, Value
from memmlp.sweep.search.study import Study, deviations, reason

SHOWN = 5  # how many of the best trials are shown
ENDS = {TrialState.COMPLETE: "complete", TrialState.PRUNED: "pruned", TrialState.FAIL: "failed"}


class SearchBoard(Screen):
    """Shows a search in progress.

    Args:
        outputs: the folder of runs and caches.
    """

    def __init__(self, outputs: Path):
        super().__init__()
        self.outputs = outputs
        self.printed: set[int] | None = None

    def update(self, study: Study) -> None:
        """Show the study, and the runs of its trials, in their present state."""
        ended = [trial for trial in study.trials if trial.state in ENDS]
        numbers = {trial.number for trial in ended}
        printed = numbers if self.printed is None else self.printed
        changes = [describe_end(one) for one in ended if one.number not in printed]

        def progress() -> list[str]:
            return [
                f"trial {trial.number}: {_describe_runs(trial, runs)}"
                for trial, runs in running_trials(study, self.outputs)
                if any(run.activity for run in runs)
            ]

        count = f"{len(ended)} of {study.search.n_trials}"
        self.show(lambda: render(study, self.outputs), count, changes, progress)
        self.printed = numbers


def describe_end(trial: FrozenTrial) -> str:
    """Describe how a trial ended."""
    result = figures(trial) if trial.state == TrialState.COMPLETE else reason(trial)
    params = ", ".join(f"{key}={_short_value(value)}" for key, value in trial.params.items())
    return f"trial {trial.number} {ENDS[trial.state]}: {result} ({params})"


def runs_of(trial: FrozenTrial, outputs: Path) -> list[Run]:
    """Return the runs that a trial has needed so far."""
    return [Run.from_id(outputs, run_id) for run_id in trial.user_attrs.get("runs", ())]


def running_trials(study: Study, outputs: Path) -> list[tuple[FrozenTrial, list[Run]]]:
    """Return the trials that have not ended, each with its runs."""
    return [(trial, runs_of(trial, outputs)) for trial in study.trials if trial.state not in ENDS]


def figures(trial: FrozenTrial) -> str:
    """Return a trial's objective values as text, with standard deviations if it has several seeds."""
    shown = [f"{value:.3f}" for value in trial.values or []]
    if spread := deviations(trial):
        shown = [f"{value} ± {sd:.3f}" for value, sd in zip(shown, spread, strict=True)]
    return ", ".join(shown)


def render(study: Study, outputs: Path) -> Group:
    """Draw the running trials, the best ones, and the counts."""
    table = trials_table(study.search, f"search {study.search.name}")
    for trial, runs in running_trials(study, outputs):
        add_row(table, study.search, trial, _describe_runs(trial, runs))
    ranked = sorted((t for t in study.trials if t.state == TrialState.COMPLETE), key=lambda t: t.values)
    for trial in ranked[:SHOWN]:
        add_row(table, study.search, trial, Text(figures(trial), style="green"))
    return Group(table, Text(count_trials(study)))


def _describe_runs(trial: FrozenTrial, runs: Sequence[Run]) -> Text:
    current = next((run for run in runs if run.activity), None)
    count = sum(run.done for run in runs if run is not current)
    done = f"{count} seeds done, " if count else ""
    if current is None:
        return Text(f"{done}waiting")
    return Text(done + progress_text(current, trial.user_attrs["steps"]), style="cyan")


def trials_table(search: Search, title: str) -> Table:
    """Make an empty table of trials, with a column for each searched key."""
    table = titled_table(title)
    table.add_column("trial", justify="right")
    table.add_column(", ".join(objective.text for objective in search.objectives))
    for name in shorten(one.key for one in search.space):
        table.add_column(name, justify="right")
    return table


def shorten(keys: Iterable[str]) -> list[str]:
    """Return the keys without their group, if all of them have the same group."""
    every = list(keys)
    groups = {key.rpartition(".")[0] for key in every}
    return [key.rpartition(".")[2] for key in every] if len(groups) == 1 else every


def add_row(table: Table, search: Search, trial: FrozenTrial, state: Text) -> None:
    """Add a trial's row to a table."""
    values = [Text(_short_value(trial.params.get(one.key, ""))) for one in search.space]
    table.add_row(str(trial.number), state, *values)


def _short_value(value: Value) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def count_trials(study: Study) -> str:
    """Say how many trials are in each state, and how many are wanted."""
    counts = Counter(ENDS.get(trial.state, "running") for trial in study.trials)
    listed = ", ".join(f"{count} {state}" for state, count in counts.items())
    return f"{len(study.trials)} of {study.search.n_trials} trials: {listed or 'none yet'}"
