"""The live table of a sweep: variants by seeds, what is done, running and waiting, and why runs failed."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Self

from rich import box
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from memmlp.runs.identity import NETWORK, find_training_settings
from memmlp.runs.lookup import describe_kind
from memmlp.runs.metrics_log import LogRecord
from memmlp.runs.run import Run
from memmlp.sweep.plan import Plan, RunTask

COLOURS = {
    "done": "green", "running": "cyan", "failed": "red", "blocked": "red", "lost": "yellow",
    "trained": "yellow",
}  # fmt: skip
STATE_NAMES = {
    "new": "waiting", "trained": "trained, unfinished",
    "stopped": "waiting, started", "lost": "lost, to be taken over",
}  # fmt: skip
VARIANT_WIDTH = 20  # columns that a variant's name has at least, or as many as it needs
QUIET = 300.0  # seconds without a line, in a log, after which the progress of the running runs is printed


class Screen:
    """Shows content that changes: in place on a terminal, elsewhere as one line for every change.

    At the beginning, and where nothing changes for long, it prints lines about the running runs.
    """

    last_line: float | None = None
    """When the last line was printed, by time.monotonic."""

    def __init__(self, console: Console | None = None):
        self.console = console or Console(highlight=False, stderr=True)
        self.live = Live(console=self.console, refresh_per_second=4, transient=False)

    def __enter__(self) -> Self:
        if self.console.is_terminal:
            self.live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self.console.is_terminal:
            self.live.stop()

    def show(
        self,
        whole: Callable[[], RenderableType],
        count: str,
        changes: Sequence[str],
        progress: Callable[[], Sequence[str]],
    ) -> None:
        """Show the whole content on a terminal; elsewhere print the lines about what changed.

        `whole` and `progress` are called only if their results are shown. `count` precedes each line.
        """
        if self.console.is_terminal:
            self.live.update(whole())
            return
        now = time.monotonic()
        if not changes and (self.last_line is None or now - self.last_line >= QUIET):
            changes = progress() or ["workers are starting"]
        for line in changes:
            self.console.print(f"{count}; {line}", soft_wrap=True, markup=False)
            self.last_line = now


def titled_table(title: str) -> Table:
    """Return an empty table with a title."""
    return Table(box=box.SIMPLE_HEAD, pad_edge=False, title=title, title_justify="left")


class Board(Screen):
    """Shows the state of a plan: variants by seeds."""

    before: Mapping[str, str] | None = None

    def update(self, plan: Plan, states: Mapping[str, str]) -> None:
        """Show the plan with its tasks in these states."""
        done = f"{sum(state == 'done' for state in states.values())} of {len(states)} done"
        changed = [
            task for task in plan.tasks if self.before and self.before.get(task.key) != states[task.key]
        ]
        changes = [_describe_change(plan, task, states[task.key]) for task in changed]

        def progress() -> list[str]:
            return [
                f"{task_name(plan, task)}: {progress_text(plan.run_of(task), total_steps(task))}"
                for task in plan.tasks
                if states[task.key] == "running"
            ]

        self.show(lambda: render(plan, states), done, changes, progress)
        self.before = states


def _describe_change(plan: Plan, task: RunTask, state: str) -> str:
    run = plan.run_of(task)
    reason = run.failure if state == "failed" else None
    return f"{task_name(plan, task)}: {STATE_NAMES.get(state, state)}{f', {reason}' if reason else ''}"


def task_name(plan: Plan, task: RunTask) -> str:
    """Return the task's readable name: variant and seed, or kind of run and the seeds that need it."""
    for entry in plan.entries:
        if entry.key == task.key:
            return f"{entry.label} seed {entry.seed}"
    users = {task.id}
    for other in plan.tasks:  # each after those that it needs
        users |= {other.id} if other.prerequisite in users else set()
    seeds = sorted({entry.seed for entry in plan.entries if entry.id in users})
    of_seeds = f" of seed {', '.join(map(str, seeds))}" if seeds else ""
    return f"{describe_kind(task.kind)} {task.id}{of_seeds}"


def render(plan: Plan, states: Mapping[str, str]) -> Group:
    """Draw variants by seeds, prerequisite runs, the counts of states, and the reasons of failures."""
    tasks = {task.key: task for task in plan.tasks}
    seeds = sorted({entry.seed for entry in plan.entries})
    table = titled_table(f"sweep {plan.name}")
    labels = list(dict.fromkeys(entry.label for entry in plan.entries))
    width = min(VARIANT_WIDTH, max(map(len, labels), default=0))
    table.add_column("variant", overflow="fold", min_width=width)
    for seed in seeds:
        table.add_column(f"seed {seed}")
    for label in labels:
        cells = {
            e.seed: state_text(plan, tasks[e.key], states[e.key]) for e in plan.entries if e.label == label
        }
        table.add_row(Text(label), *(cells.get(seed, Text("-")) for seed in seeds))
    below = [
        Text(f"{task_name(plan, task)}: ") + state_text(plan, task, states[task.key])
        for task in plan.tasks
        if task.kind != NETWORK
    ]
    counts = Counter(STATE_NAMES.get(state, state).partition(",")[0] for state in states.values())
    below.append(Text(", ".join(f"{count} {state}" for state, count in counts.items())))
    if any(states[task.key] == "done" and result(plan.run_of(task)) for task in plan.tasks):
        below.append(Text("cm: done; MPJPE in stream mode of the rotation branch, a table may show another"))
    below += [
        Text(f"{task_name(plan, task)}: {plan.run_of(task).failure}", style="red")
        for task in plan.tasks
        if states[task.key] == "failed"
    ]
    return Group(table, *below)


def state_text(plan: Plan, task: RunTask, state: str) -> Text:
    """Describe a run in a few characters."""
    run, style = plan.run_of(task), COLOURS.get(state, "")
    if state == "running":
        return Text(progress_text(run, total_steps(task)), style=style)
    if state == "done":
        return Text(result(run) or state, style=style)
    return Text(STATE_NAMES.get(state, state), style=style)


def result(run: Run) -> str:
    """Return the stream-mode MPJPE of a finished run, rotation branch, as text; empty if not measured."""
    value = run.results.get("stream", {}).get("rotation", {}).get("MPJPE")
    return f"{value:.2f} cm" if isinstance(value, int | float) else ""


def total_steps(task: RunTask) -> int:
    """Return the number of steps of the task's training."""
    return int(find_training_settings(task.kind, task.config)["steps"])


def progress_text(run: Run, total: int) -> str:
    """Describe a run that a process is working on: steps of its training, remaining time and loss."""
    if (doing := run.activity) in ("evaluating", "exporting"):
        return doing
    log = [entry for entry in run.metrics() if entry.phase == "train"]
    if not log:
        return "starting"
    if log[-1].step >= total:
        return "evaluating"
    seconds = time_left(log, total)
    left = ""
    if seconds is not None:
        left = f" {seconds / 60:.0f} min" if seconds >= 90 else f" {seconds:.0f} s"
    return f"{log[-1].step}/{total}{left} loss {log[-1].values['loss']:.3g}"


def time_left(log: list[LogRecord], total: int) -> float | None:
    """Return the seconds to the end of training, at the rate of the log's last five entries.

    Return None if there is no rate yet.
    """
    recent = log[-5:]
    steps, seconds = recent[-1].step - recent[0].step, recent[-1].time - recent[0].time
    if steps <= 0 or seconds <= 0:
        return None
    return max((total - recent[-1].step) * seconds / steps - (time.time() - recent[-1].time), 0.0)
