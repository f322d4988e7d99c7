"""Progress of long work: bars with the remaining time on a terminal, otherwise lines for a log."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Iterable, Iterator, Sized
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

T = TypeVar("T")

INTERVAL = 30.0  # seconds between two progress lines

_label: ContextVar[str] = ContextVar("label of the larger work", default="")
_file: ContextVar[Path | None] = ContextVar("file of the lines about work", default=None)
_printed: ContextVar[bool] = ContextVar("whether lines about work are printed", default=False)


@contextmanager
def _set(variable: ContextVar[T], value: T) -> Iterator[None]:
    token = variable.set(value)
    try:
        yield
    finally:
        variable.reset(token)


def print_announcements() -> AbstractContextManager[None]:
    """Print announcements and progress lines of the context to stderr."""
    return _set(_printed, True)


def keep_announcements(path: Path) -> AbstractContextManager[None]:
    """Append announcements and progress lines of the context to a file, too, with the time."""
    return _set(_file, path)


def announce(line: str, on_terminal: bool = False) -> None:
    """Print a line, such as the name of the next step, in the context of `print_announcements`. A terminal
    shows progress bars instead, unless `on_terminal` is set."""
    if path := _file.get():
        with contextlib.suppress(OSError), open(path, "a", encoding="utf-8") as file:
            file.write(f"{time.strftime('%Y-%m-%d %H:%M:%S')} {line}\n")
    if _printed.get() and (on_terminal or not sys.stderr.isatty()):
        print(line, file=sys.stderr, flush=True)


def notify(line: str) -> None:
    """Print a line that the user should see, such as skipped files; unlike `announce`, also on a terminal."""
    announce(line, on_terminal=True)


def label_progress(name: str) -> AbstractContextManager[None]:
    """Label all progress bars of the context with the name of the larger work, such as a validation."""
    return _set(_label, name)


class ProgressCounter:
    """Counts the finished items of some work, in a bar at this row of the display, and announces the number
    every INTERVAL seconds."""

    def __init__(self, display: Progress, row: TaskID, unit: str = ""):
        self.display, self.row, self.unit = display, row, unit
        self.announced = time.monotonic()

    def advance(self) -> None:
        """Count one more finished item."""
        self.display.advance(self.row)
        if time.monotonic() - self.announced >= INTERVAL:
            self.announced = time.monotonic()
            announce(self.line)

    def set_note(self, text: str) -> None:
        """Replace the text behind the numbers, such as the loss."""
        self.display.update(self.row, note=text)

    @property
    def line(self) -> str:
        """The progress line, such as "Mem-MLP: 400 of 4000 steps, loss 2.31, 6 min left"."""
        task = self.display.tasks[0]
        total = "" if task.total is None else f" of {task.total:.0f}"
        count = f"{task.completed:.0f}{total} {self.unit}".rstrip()
        seconds = task.time_remaining
        parts = [count, task.fields["note"]]
        if seconds is not None:
            parts.append(f"{seconds / 60:.0f} min left" if seconds >= 90 else f"{seconds:.0f} s left")
        return f"{task.description}: {', '.join(filter(None, parts))}"


@contextmanager
def show_progress(
    description: str, total: float | None, done: int = 0, shown: bool = True, unit: str = ""
) -> Iterator[ProgressCounter]:
    """Show the progress of some work on stderr: description, bar, count, elapsed and remaining time, a note.
    `total` is None if unknown; `done` items are already finished; `unit` is that of the count, such as
    frames."""
    from rich import progress  # imported here, since printing help does not need it

    from memmlp.common.text_formats import make_console

    console = make_console(stderr=True)
    display = progress.Progress(
        progress.TextColumn("{task.description:<12}"),
        progress.BarColumn(bar_width=24),
        progress.MofNCompleteColumn(),
        *([progress.TextColumn(unit)] if unit else []),
        progress.TimeElapsedColumn(),
        progress.TextColumn("elapsed,"),
        progress.TimeRemainingColumn(),
        progress.TextColumn("left"),
        progress.TextColumn("{task.fields[note]}"),
        console=console,
        disable=not (shown and console.is_terminal),
    )
    label = ", ".join(filter(None, (_label.get(), description)))
    with display:
        yield ProgressCounter(display, display.add_task(label, total=total, completed=done, note=""), unit)


def progress_bar(
    items: Iterable[T], description: str, total: int | None = None, unit: str = ""
) -> Iterator[T]:
    """Yield the items while a progress bar counts them. `total` is their number, if `items` has no length."""
    if total is None and isinstance(items, Sized):
        total = len(items)
    with show_progress(description, total, unit=unit) as count:
        for item in items:
            yield item
            count.advance()
