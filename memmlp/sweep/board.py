"""The live table of a sweep: arm by seed, what is done, running and waiting, and why something failed."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from typing import Self

from rich import box
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from memmlp.runs.log import Metrics
from memmlp.runs.run import Run
from memmlp.sweep.plan import Plan, RunTask

COLOURS = {"done": "green", "running": "cyan", "failed": "red", "blocked": "red", "lost": "yellow"}
WORDS = {"new": "waiting", "stopped": "waiting, begun", "lost": "lost, to be taken over"}


class Screen:
    """What changes, shown in place on a terminal; elsewhere a line for every change."""

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

    def show(self, whole: Callable[[], RenderableType], changes: Iterable[str]) -> None:
        """Show the whole on a terminal, elsewhere the lines of what changed."""
        if self.console.is_terminal:
            self.live.update(whole())
        else:
            for line in changes:
                self.console.print(line, soft_wrap=True, markup=False)


class Board(Screen):
    """Shows a plan's state: arms by seeds."""

    before: Mapping[str, str] | None = None

    def update(self, plan: Plan) -> None:
        """Show the plan as it is now."""
        states = plan.states()
        self.show(lambda: render(plan, states), self._changes(plan, states))
        self.before = states

    def _changes(self, plan: Plan, states: Mapping[str, str]) -> list[str]:
        """A line for each task whose state is another than before."""
        if self.before is None:
            return []
        changed = [task for task in plan.tasks if self.before.get(task.key) != states[task.key]]
        done = sum(state == "done" for state in states.values())
        return [f"{done} of {len(states)} done; {_change(plan, t, states[t.key])}" for t in changed]


def _change(plan: Plan, task: RunTask, state: str) -> str:
    """What became of a task, and why."""
    reason = plan.run_of(task).failure if state == "failed" else None
    return f"{name(plan, task)}: {WORDS.get(state, state)}{f', {reason}' if reason else ''}"


def name(plan: Plan, task: RunTask) -> str:
    """The task as a person knows it: arm and seed, of a VQ-VAE the seeds whose runs need it."""
    cells = [f"{entry.label} seed {entry.seed}" for entry in plan.entries if entry.key == task.key]
    return cells[0] if cells else f"VQ-VAE {task.id}{_seeds(plan, task)}"


def _seeds(plan: Plan, upstream: RunTask) -> str:
    """The seeds of the entries that need that run."""
    users = {task.id for task in plan.tasks if task.upstream == upstream.id}
    seeds = sorted({entry.seed for entry in plan.entries if entry.id in users})
    return f" of seed {', '.join(map(str, seeds))}" if seeds else ""


def render(plan: Plan, states: Mapping[str, str]) -> Group:
    """Arms by seeds, the VQ-VAEs, the counts, and the reasons of what failed."""
    tasks = {task.key: task for task in plan.tasks}
    seeds = sorted({entry.seed for entry in plan.entries})
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, title=f"sweep {plan.name}", title_justify="left")
    table.add_column("arm", overflow="fold")
    for seed in seeds:
        table.add_column(f"seed {seed}", no_wrap=True)
    for label in dict.fromkeys(entry.label for entry in plan.entries):
        cells = {e.seed: cell(plan, tasks[e.key], states[e.key]) for e in plan.entries if e.label == label}
        table.add_row(Text(label), *(cells.get(seed, Text("-")) for seed in seeds))
    below = [_upstream(plan, task, states[task.key]) for task in plan.tasks if task.kind == "vqvae"]
    below += [Text(_counts(states))]
    below += [
        Text(f"{name(plan, task)}: {plan.run_of(task).failure}", style="red")
        for task in plan.tasks
        if states[task.key] == "failed"
    ]
    return Group(table, *below)


def cell(plan: Plan, task: RunTask, state: str) -> Text:
    """A run in a few characters."""
    run = plan.run_of(task)
    if state == "running":
        return Text(progress(run, total_steps(task)), style=COLOURS[state])
    if state == "done":
        return Text(f"done {result(run)}".rstrip(), style=COLOURS[state])
    return Text(WORDS.get(state, state), style=COLOURS.get(state, ""))


def _upstream(plan: Plan, task: RunTask, state: str) -> Text:
    return Text(f"{name(plan, task)}: ") + cell(plan, task, state)


def result(run: Run) -> str:
    """The stream-mode MPJPE of a finished run."""
    value = run.results.get("stream", {}).get("rotation", {}).get("MPJPE")
    return f"{value:.2f} cm" if isinstance(value, int | float) else ""


def total_steps(task: RunTask) -> int:
    """Steps of the task's training."""
    return int(task.config["vqvae" if task.kind == "vqvae" else "optim"]["steps"])


def progress(run: Run, total: int) -> str:
    """Steps, time left and loss of a run in training."""
    log = [entry for entry in run.metrics() if entry.phase == "train"]
    if not log:
        return "starting"
    if log[-1].step >= total:
        return "evaluating"
    left = time_left(log, total)
    return f"{log[-1].step}/{total}{_words(left)} loss {log[-1].values['loss']:.3g}"


def _words(seconds: float | None) -> str:
    """A time left, to the minute where it is long."""
    if seconds is None:
        return ""
    return f" {seconds / 60:.0f} min" if seconds >= 90 else f" {seconds:.0f} s"


def time_left(log: list[Metrics], total: int) -> float | None:
    """Seconds to the end of training at the rate of the last entries; None where there is no rate yet."""
    recent = log[-5:]
    steps, seconds = recent[-1].step - recent[0].step, recent[-1].time - recent[0].time
    if steps <= 0 or seconds <= 0:
        return None
    return max((total - recent[-1].step) * seconds / steps - (time.time() - recent[-1].time), 0.0)


def _counts(states: Mapping[str, str]) -> str:
    """How many runs are in which state."""
    counts: dict[str, int] = {}
    for state in states.values():
        word = WORDS.get(state, state).partition(",")[0]
        counts[word] = counts.get(word, 0) + 1
    return ", ".join(f"{count} {word}" for word, count in counts.items())
