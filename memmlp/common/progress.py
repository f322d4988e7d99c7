"""Progress reports on long work: bars with the time left on a terminal, elsewhere lines for a log."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

T = TypeVar("T")

EVERY = 30.0  # seconds between two lines about how far the same work is

_DURING: ContextVar[str] = ContextVar("what the work is part of", default="")

_SAY: ContextVar[Callable[[str], None] | None] = ContextVar("what is told of work", default=None)


def to_stderr(line: str) -> None:
    """Write a line to stderr."""
    print(line, file=sys.stderr, flush=True)


def to_log(line: str) -> None:
    """Write a line to stderr, unless stderr is a terminal, which has the bars."""
    if not sys.stderr.isatty():
        to_stderr(line)


@contextmanager
def telling(say: Callable[[str], None] = to_log) -> Iterator[None]:
    """Send the lines about work in this context to `say`: what begins and, now and then, the progress."""
    token = _SAY.set(say)
    try:
        yield
    finally:
        _SAY.reset(token)


def tell(line: str) -> None:
    """Report a line about the work, such as what begins now, to the listener set by `telling`, if any."""
    if say := _SAY.get():
        say(line)


def remark(line: str) -> None:
    """Report what the user should know, such as skipped files: as `tell` does, but on a terminal, too."""
    if say := _SAY.get():
        (to_stderr if say is to_log else say)(line)


@contextmanager
def during(name: str) -> Iterator[None]:
    """Label the progress bars of this context with the larger work that they are a part of: a validation."""
    token = _DURING.set(name)
    try:
        yield
    finally:
        _DURING.reset(token)


class Count:
    """Counts how much of some work is done.

    A terminal shows a bar; a listener (`telling`) gets a line every EVERY seconds.

    Args:
        display: draws the bar.
        row: the bar's row in the display.
        unit: what is counted, such as frames.
    """

    def __init__(self, display: Progress, row: TaskID, unit: str = ""):
        self.display, self.row, self.unit = display, row, unit
        self.said = time.monotonic()

    def advance(self) -> None:
        """Count one more."""
        self.display.advance(self.row)
        if time.monotonic() - self.said >= EVERY:
            self.said = time.monotonic()
            tell(self.line)

    def note(self, text: str) -> None:
        """Replace the remark after the numbers, such as the loss."""
        self.display.update(self.row, note=text)

    @property
    def line(self) -> str:
        """The progress in a line, such as "Mem-MLP: 400 of 4000 steps, loss 2.31, 6 min left"."""
        task = self.display.tasks[0]
        far = f"{task.completed:.0f}" + ("" if task.total is None else f" of {task.total:.0f}")
        far = f"{far} {self.unit}".rstrip()
        left = "" if task.time_remaining is None else f"{duration(task.time_remaining)} left"
        return f"{task.description}: {', '.join(filter(None, (far, task.fields['note'], left)))}"


def duration(seconds: float) -> str:
    """Return a duration as text, in minutes if it is long."""
    return f"{seconds / 60:.0f} min" if seconds >= 90 else f"{seconds:.0f} s"


@contextmanager
def counting(
    description: str, total: float | None, done: int = 0, shown: bool = True, unit: str = ""
) -> Iterator[Count]:
    """Show the progress of some work on stderr: description, bar, count, elapsed and remaining time, a note.

    Args:
        description: the name of the work.
        total: how much there is to do; None if that is not known.
        done: how much of it is done already.
        shown: whether this process shows it.
        unit: what is counted, such as frames.
    """
    from rich import progress  # here, since the help of all commands comes by without it
    from rich.console import Console

    console = Console(stderr=True)
    display = progress.Progress(
        progress.TextColumn("{task.description:<12}"),
        progress.BarColumn(bar_width=24),
        progress.MofNCompleteColumn(),
        *([progress.TextColumn(unit)] if unit else []),
        progress.TimeElapsedColumn(),
        progress.TextColumn("gone,"),
        progress.TimeRemainingColumn(),
        progress.TextColumn("left"),
        progress.TextColumn("{task.fields[note]}"),
        console=console,
        disable=not (shown and console.is_terminal),
    )
    label = ", ".join(filter(None, (_DURING.get(), description)))
    with display:
        yield Count(display, display.add_task(label, total=total, completed=done, note=""), unit)


def progress_bar(
    items: Iterable[T], description: str, total: int | None = None, unit: str = ""
) -> Iterator[T]:
    """Yield the items while a progress bar counts them.

    Args:
        items: what to iterate over.
        description: the bar's label.
        total: the number of items, if `items` has no length.
        unit: what the items are, such as frames.
    """
    if total is None and isinstance(items, Sized):
        total = len(items)
    with counting(description, total, unit=unit) as count:
        for item in items:
            yield item
            count.advance()
