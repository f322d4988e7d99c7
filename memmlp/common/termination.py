"""How a command ends on request: what it has begun is finished first."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator
from typing import Protocol


class Closing(Protocol):
    """An object that has to be finished."""

    def close(self) -> None:
        """Finish the work."""


@contextlib.contextmanager
def closed_in_peace(thing: Closing) -> Iterator[None]:
    """Close an object at the end of the context, even if another Ctrl-C or SIGTERM arrives meanwhile."""
    try:
        yield
    finally:
        before = {number: signal.signal(number, signal.SIG_IGN) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            thing.close()
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


@contextlib.contextmanager
def termination_interrupts() -> Iterator[None]:
    """Treat a request to end (SIGTERM) like a Ctrl-C."""

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
