"""Progress bars that show the time left, silent where stderr is no terminal; lines that say what begins."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

T = TypeVar("T")

_SAY: ContextVar[Callable[[str], None] | None] = ContextVar("what is told of stages", default=None)


def stage_begins(line: str) -> None:
    """Say in a line what begins now, where somebody listens (`telling_stages`)."""
    if say := _SAY.get():
        say(line)


@contextmanager
def telling_stages(say: Callable[[str], None]) -> Iterator[None]:
    """Hand the lines of stages that begin in this context to `say`."""
    token = _SAY.set(say)
    try:
        yield
    finally:
        _SAY.reset(token)


def progress(shown: bool = True) -> Progress:
    """Make a progress display on stderr: description, bar, count, elapsed time, time left, and a note.

    It is hidden where stderr is no terminal, or it is not to be `shown`.
    """
    console = Console(stderr=True)
    return Progress(
        TextColumn("{task.description:<12}"),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
        console=console,
        disable=not (shown and console.is_terminal),
    )


def progress_bar(items: Iterable[T], description: str, total: int | None = None) -> Iterator[T]:
    """Yield the items while a progress bar counts them.

    Args:
        items: what to iterate over.
        description: the bar's label.
        total: the number of items, where `items` does not know its length.
    """
    if total is None and isinstance(items, Sized):
        total = len(items)
    with progress() as bar:
        task = bar.add_task(description, total=total, note="")
        for item in items:
            yield item
            bar.advance(task)
