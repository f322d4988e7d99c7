"""The live table of a sweep: the state of each variant and seed, and the reasons of failures."""

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Self

from rich import box
from rich.console import Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from memmlp.common.text_formats import make_console
from memmlp.runs.identity import NETWORK
from memmlp.runs.lookup import describe_kind
from memmlp.runs.metrics_log import LogRecord
from memmlp.runs.run import Run
from memmlp.sweep.plan import Plan, RunTask

COLOURS = {
    "done": "green", "running": "cyan", "failed": "red", "damaged": "red", "blocked": "red", "lost": "yellow",
    "stopped": "yellow", "trained": "yellow",
}  # fmt: skip
STATE_NAMES = {
    "new": "waiting", "trained": "trained, unfinished",
    "interrupted": "waiting, started", "lost": "lost, to be taken over",
}  # fmt: skip
FAULTS = ("failed", "damaged")  # states with a reason
VARIANT_WIDTH = 20  # the minimum width of the variants' column, unless all labels are shorter
QUIET = 300.0  # seconds without a line in a log before the progress of running runs is printed


class Screen:
    """Shows changing content: in place on a terminal, otherwise as one line for each change, and lines about
    running runs at the start and after QUIET seconds without a change."""

    last_line: float | None = None  # the time of the last printed line, by time.monotonic

    def __init__(self) -> None:
        self.console = make_console(stderr=True)
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
        render_all: Callable[[], RenderableType],
        count: str,
        changes: Sequence[str],
        describe_running: Callable[[], Sequence[str]],
    ) -> None:
        """Show the whole content on a terminal; otherwise print a line for each change since the last call,
        or else lines about running runs, each after `count`, such as "3 of 9 done". The functions are called
        only if their results are shown."""
        if self.console.is_terminal:
            self.live.update(render_all())
            return
        now = time.monotonic()
        if not changes and (self.last_line is None or now - self.last_line >= QUIET):
            changes = describe_running() or ["workers are starting"]
        for line in changes:
            self.console.print(f"{count}; {line}", soft_wrap=True, markup=False)
            self.last_line = now


def make_titled_table(title: str) -> Table:
    return Table(box=box.SIMPLE_HEAD, pad_edge=False, title=title, title_justify="left")


class Board(Screen):
    """Shows a plan as a table of variants by seeds."""

    before: Mapping[str, str] | None = None

    def update(self, plan: Plan, states: Mapping[str, str]) -> None:
        done = f"{sum(state == 'done' for state in states.values())} of {len(states)} done"
        before = self.before or states
        changed = [task for task in plan.tasks if before.get(task.key) != states[task.key]]
        changes = [_describe_change(plan, task, states[task.key]) for task in changed]

        def describe_running() -> list[str]:
            return [
                f"{describe_task(plan, task)}: {describe_progress(plan.get_run(task))}"
                for task in plan.tasks
                if states[task.key] == "running"
            ]

        self.show(lambda: render(plan, states), done, changes, describe_running)
        self.before = states


def _describe_change(plan: Plan, task: RunTask, state: str) -> str:
    run = plan.get_run(task)
    reason = run.fault if state in FAULTS else None
    return f"{describe_task(plan, task)}: {STATE_NAMES.get(state, state)}{f', {reason}' if reason else ''}"


def describe_task(plan: Plan, task: RunTask) -> str:
    """Return a task's readable name: the variant and the seed; for a prerequisite run, the kind, the id and
    the seeds that need it."""
    for entry in plan.entries:
        if entry.key == task.key:
            return f"{entry.label} seed {entry.seed}"
    users = {task.id}
    for other in plan.tasks:  # a task comes after its prerequisite
        users |= {other.id} if other.prerequisite in users else set()
    seeds = sorted({entry.seed for entry in plan.entries if entry.id in users})
    of_seeds = f" of seed {', '.join(map(str, seeds))}" if seeds else ""
    return f"{describe_kind(task.kind)} {task.id}{of_seeds}"


def render(plan: Plan, states: Mapping[str, str]) -> Group:
    """Return the table of variants by seeds, with prerequisite runs, counts and failures below it."""
    tasks = {task.key: task for task in plan.tasks}
    seeds = sorted({entry.seed for entry in plan.entries})
    table = make_titled_table(f"sweep {plan.name}")
    labels = list(dict.fromkeys(entry.label for entry in plan.entries))
    width = min(VARIANT_WIDTH, max(map(len, labels), default=0))
    table.add_column("variant", overflow="fold", min_width=width)
    for seed in seeds:
        table.add_column(f"seed {seed}")
    for label in labels:
        entries = [entry for entry in plan.entries if entry.label == label]
        cells = {e.seed: format_state(plan, tasks[e.key], states[e.key]) for e in entries}
        table.add_row(Text(label), *(cells.get(seed, Text("-")) for seed in seeds))
    below = [
        Text(f"{describe_task(plan, task)}: ") + format_state(plan, task, states[task.key])
        for task in plan.tasks
        if task.kind != NETWORK
    ]
    counts = Counter(STATE_NAMES.get(state, state).partition(",")[0] for state in states.values())
    below.append(Text(", ".join(f"{count} {state}" for state, count in counts.items())))
    if any(states[task.key] == "done" and format_result(plan.get_run(task)) for task in plan.tasks):
        legend = "cm: done; MPJPE of the rotation branch in stream mode (tables may show other branches)"
        below.append(Text(legend))
    below += [
        Text(f"{describe_task(plan, task)}: {plan.get_run(task).fault}", style="red")
        for task in plan.tasks
        if states[task.key] in FAULTS
    ]
    return Group(table, *below)


def format_state(plan: Plan, task: RunTask, state: str) -> Text:
    run, style = plan.get_run(task), COLOURS.get(state, "")
    if state == "running":
        return Text(describe_progress(run), style=style)
    if state == "done":
        return Text(format_result(run) or state, style=style)
    return Text(STATE_NAMES.get(state, state), style=style)


def format_result(run: Run) -> str:
    """Return the rotation branch's stream-mode MPJPE as text; empty if it was not measured."""
    value = run.results.get("stream", {}).get("rotation", {}).get("MPJPE")
    return f"{value:.2f} cm" if isinstance(value, int | float) else ""


def describe_progress(run: Run) -> str:
    """Return a running run's training steps, remaining time and loss as text."""
    total = run.total_steps
    if (doing := run.activity) in ("evaluating", "exporting"):
        return doing
    log = [entry for entry in run.metrics() if entry.phase == "train"]
    if not log:
        return "starting"
    if log[-1].step >= total:
        return "evaluating"
    seconds = estimate_time_left(log, total)
    left = ""
    if seconds is not None:
        left = f" {seconds / 60:.0f} min" if seconds >= 90 else f" {seconds:.0f} s"
    return f"{log[-1].step}/{total}{left} loss {log[-1].values['loss']:.3g}"


def estimate_time_left(log: list[LogRecord], total: int) -> float | None:
    """Estimate the remaining seconds of training from the log's last five entries; None before there are two
    entries at different steps."""
    recent = log[-5:]
    steps, seconds = recent[-1].step - recent[0].step, recent[-1].time - recent[0].time
    if steps <= 0 or seconds <= 0:
        return None
    return max((total - recent[-1].step) * seconds / steps - (time.time() - recent[-1].time), 0.0)
