"""Shows runs in loggers while they happen, by threads that read the runs' folders.

The metrics log on disk is the queue between a run and its loggers: the run never waits for a logger, and
nothing is lost if a logger is slow or fails. `memmlp loggers sync` fills in what a logger missed.
"""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from memmlp.runs.loggers.facts import CurvePoint, RunFacts, Tail, read_run
from memmlp.runs.run import Run

PACE = 1.0  # seconds between two looks at a run's log
MAX_PAUSE = 60.0  # seconds between two tries of a logger that fails
MAX_WAIT = 30.0  # seconds for which a run's end waits for its loggers


class ShownRun(Protocol):
    """A run in a logger. Every method may block and may raise."""

    def log(self, points: Sequence[CurvePoint]) -> None:
        """Show further values of the curves."""

    def end(self, facts: RunFacts) -> None:
        """Show the run's end or failure, its results, files and fingerprint; nothing more follows."""

    def close(self) -> None:
        """Release the run, whether or not it ended."""


class RunLogger(Protocol):
    """The interface of loggers. Every method may block and may raise.

    Attributes:
        name: the option's name.
    """

    name: str

    @property
    def place(self) -> str:
        """Where the logger shows runs: an address or a folder."""

    def fingerprint(self, run_id: str) -> str | None:
        """Return the fingerprint of the facts with which a run ended in the logger; None if it did not."""

    def begin(self, facts: RunFacts, points: Sequence[CurvePoint]) -> ShownRun:
        """Show a run with exactly these facts and points, replacing whatever the logger had of it."""


class Session:
    """Shows one run in one logger, from the run's start to its end."""

    def __init__(self, logger: RunLogger, run: Run):
        self.logger, self.run = logger, run
        self.shown: ShownRun | None = None

    def update(self) -> None:
        """Show what is new in a run that goes on."""
        with self._closing_on_failure():
            if self.shown is None:
                if self.run.manifest_path.exists():
                    self._begin(read_run(self.run, running=True))
            elif points := self.tail.read():
                self.shown.log(points)

    def end(self) -> None:
        """Show the run's final state."""
        if not self.run.manifest_path.exists():
            return  # it never started
        with self._closing_on_failure():
            facts = read_run(self.run)
            shown = self.shown or self._begin(facts)
            if points := self.tail.read():
                shown.log(points)
            if self.tail.repeated:  # loggers can't take back what the run logged before it was resumed
                shown = self._begin(facts)
            shown.end(facts)
        self.close()

    def close(self) -> None:
        """Release the run."""
        shown, self.shown = self.shown, None
        if shown is not None:
            shown.close()

    def _begin(self, facts: RunFacts) -> ShownRun:
        self.close()
        self.tail = Tail(self.run)
        self.shown = self.logger.begin(facts, self.tail.read())
        return self.shown

    @contextlib.contextmanager
    def _closing_on_failure(self) -> Iterator[None]:
        """Close the run after a failure, since it is unknown how much the logger received."""
        try:
            yield
        except BaseException:
            with contextlib.suppress(Exception):
                self.close()
            raise


@dataclass(frozen=True)
class Loggers:
    """The loggers in which an experiment's runs are shown.

    Attributes:
        loggers: the loggers.
        outputs: the outputs folder.
    """

    loggers: tuple[RunLogger, ...]
    outputs: Path

    @contextlib.contextmanager
    def following(self, run: Run) -> Iterator[None]:
        """Show a run during the context, and then its end or failure.

        A logger never stops the run. One that fails costs a line on stderr, and one that is slow at most
        MAX_WAIT at the end of the run.
        """
        ended = threading.Event()
        threads = self._start(lambda logger: _follow(Session(logger, run), ended), f"run {run.id}")
        try:
            yield
        finally:
            ended.set()
            _join(threads)

    def _start(self, work: Callable[[RunLogger], object], subject: str) -> list[threading.Thread]:
        threads = []
        for one in self.loggers:
            warning = f"{subject} is not shown in {one.name}"  # see `_join`
            threads.append(threading.Thread(target=work, args=(one,), name=warning, daemon=True))
            threads[-1].start()
        return threads


def _join(threads: Sequence[threading.Thread]) -> None:
    """Wait for threads, for at most MAX_WAIT, and report those that are not done."""
    end = time.monotonic() + MAX_WAIT
    for thread in threads:
        thread.join(max(end - time.monotonic(), 0))
        if thread.is_alive():
            _warn(f"{thread.name}: it is too slow")


def _follow(session: Session, ended: threading.Event) -> None:
    """Show a run until it has ended; report the first failure, and try again after growing pauses."""
    pause, failed = PACE, False

    def attempt(action: Callable[[], None]) -> bool:
        nonlocal failed
        try:
            action()
            return True
        except Exception as error:
            if not failed:
                _warn(f"run {session.run.id} is not shown in {session.logger.name}: {_reason(error)}")
            failed = True
            return False

    attempt(session.update)
    while not ended.wait(pause):
        pause = PACE if attempt(session.update) else min(2 * pause, MAX_PAUSE)
    attempt(session.end)


def _warn(line: str) -> None:
    with contextlib.suppress(OSError, ValueError):
        print(f"memmlp: warning: {line}; memmlp loggers sync adds it", file=sys.stderr, flush=True)


def _reason(error: BaseException) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__


def sync(
    logger: RunLogger, runs: Iterable[Run], say: Callable[[str], None], full: bool = False
) -> Counter[str]:
    """Update a logger, so that it has exactly the content of each run's folder.

    Args:
        logger: the logger.
        runs: the runs.
        say: gets a line about each run that could not be shown.
        full: whether runs that are up to date are shown again.

    Returns:
        How many runs were "shown", were up to date ("same"), are in progress ("live"), or "failed".
    """
    counts: Counter[str] = Counter()
    for run in runs:
        try:
            if run.doing:
                counts["live"] += 1
            elif not full and logger.fingerprint(run.id) == read_run(run).fingerprint:
                counts["same"] += 1
            else:
                Session(logger, run).end()
                counts["shown"] += 1
        except Exception as error:
            counts["failed"] += 1
            say(f"run {run.id} is not shown in {logger.name}: {_reason(error)}")
    return counts
