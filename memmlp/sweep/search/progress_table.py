"""The live table of a search: the running trials, the best trials, and the number of trials in each state."""

from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

from optuna.trial import FrozenTrial, TrialState
from rich.console import Group
from rich.table import Table
from rich.text import Text

from memmlp.runs.run import Run
from memmlp.sweep.progress_table import Screen, describe_progress, make_titled_table
from memmlp.sweep.search.search_file import Search, Value
from memmlp.sweep.search.study import Study, compute_deviations, get_reason

MAX_BEST = 5  # the maximum number of best trials shown
ENDS = {TrialState.COMPLETE: "complete", TrialState.PRUNED: "pruned", TrialState.FAIL: "failed"}


class SearchBoard(Screen):
    """Shows a search in progress; `outputs` is the folder of runs and caches."""

    def __init__(self, outputs: Path):
        super().__init__()
        self.outputs = outputs
        self.printed: set[int] | None = None

    def update(self, study: Study) -> None:
        ended = [trial for trial in study.trials if trial.state in ENDS]
        numbers = {trial.number for trial in ended}
        printed = numbers if self.printed is None else self.printed
        changes = [describe_end(one) for one in ended if one.number not in printed]

        def describe_running() -> list[str]:
            return [
                f"trial {trial.number}: {_describe_runs(trial, runs)}"
                for trial, runs in list_running_trials(study, self.outputs)
                if any(run.activity for run in runs)
            ]

        count = f"{len(ended)} of {study.search.n_trials}"
        self.show(lambda: render(study, self.outputs), count, changes, describe_running)
        self.printed = numbers


def describe_end(trial: FrozenTrial) -> str:
    """Return a line about an ended trial: its objectives or the reason of its failure, and its parameters."""
    result = format_objectives(trial) if trial.state == TrialState.COMPLETE else get_reason(trial)
    params = ", ".join(f"{key}={_short_value(value)}" for key, value in trial.params.items())
    return f"trial {trial.number} {ENDS[trial.state]}: {result} ({params})"


def list_runs(trial: FrozenTrial, outputs: Path) -> list[Run]:
    return [Run.from_id(outputs, run_id) for run_id in trial.user_attrs.get("runs", ())]


def list_running_trials(study: Study, outputs: Path) -> list[tuple[FrozenTrial, list[Run]]]:
    return [(trial, list_runs(trial, outputs)) for trial in study.trials if trial.state not in ENDS]


def format_objectives(trial: FrozenTrial) -> str:
    """Return a trial's objective values as text, with standard deviations if it has several seeds."""
    shown = [f"{value:.3f}" for value in trial.values or []]
    if spread := compute_deviations(trial):
        shown = [f"{value} ± {sd:.3f}" for value, sd in zip(shown, spread, strict=True)]
    return ", ".join(shown)


def render(study: Study, outputs: Path) -> Group:
    """Return the table of the running and the best trials, with the counts below it."""
    table = make_trials_table(study.search, f"search {study.search.name}")
    for trial, runs in list_running_trials(study, outputs):
        add_row(table, study.search, trial, _describe_runs(trial, runs))
    ranked = sorted((t for t in study.trials if t.state == TrialState.COMPLETE), key=lambda t: t.values)
    for trial in ranked[:MAX_BEST]:
        add_row(table, study.search, trial, Text(format_objectives(trial), style="green"))
    return Group(table, Text(describe_counts(study)))


def _describe_runs(trial: FrozenTrial, runs: Sequence[Run]) -> Text:
    current = next((run for run in runs if run.activity), None)
    count = sum(run.done for run in runs if run is not current)
    done = f"{count} seeds done, " if count else ""
    if current is None:
        return Text(f"{done}waiting")
    return Text(done + describe_progress(current), style="cyan")


def make_trials_table(search: Search, title: str) -> Table:
    """Make an empty table of trials, with a column for each searched key."""
    table = make_titled_table(title)
    table.add_column("trial", justify="right")
    table.add_column(", ".join(objective.text for objective in search.objectives))
    for name in shorten_keys(one.key for one in search.space):
        table.add_column(name, justify="right")
    return table


def shorten_keys(keys: Iterable[str]) -> list[str]:
    """Remove the group from the keys if all of them have the same group."""
    every = list(keys)
    groups = {key.rpartition(".")[0] for key in every}
    return [key.rpartition(".")[2] for key in every] if len(groups) == 1 else every


def add_row(table: Table, search: Search, trial: FrozenTrial, state: Text) -> None:
    values = [Text(_short_value(trial.params.get(one.key, ""))) for one in search.space]
    table.add_row(str(trial.number), state, *values)


def _short_value(value: Value) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def describe_counts(study: Study) -> str:
    """Return a line with the number of trials in each state and the search's number of trials."""
    counts = Counter(ENDS.get(trial.state, "running") for trial in study.trials)
    states = ", ".join(f"{count} {state}" for state, count in counts.items())
    total = max(study.search.n_trials, len(study.trials))  # n_trials can be lowered
    return f"{len(study.trials)} of {total} trials: {states or 'none yet'}"
