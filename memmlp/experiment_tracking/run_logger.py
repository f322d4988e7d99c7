"""The slot of loggers: the interface of loggers, and a run as one logger shows it."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Protocol

from filelock import FileLock, Timeout

from memmlp.common.files import read_json, write_json
from memmlp.experiment_tracking.logged_values import (
    CurvePoint,
    RunFacts,
    SweepFacts,
    Tail,
    facts_of,
    final,
    fingerprint,
)
from memmlp.runs.run import Run


class Shown(Protocol):
    """A run that a logger is showing."""

    def log(self, points: Sequence[CurvePoint]) -> None:
        """Show further values of the curves."""

    def end(self, facts: RunFacts, results: Sequence[CurvePoint]) -> None:
        """Show the run's end or failure, its results and its files; nothing more follows."""

    def leave(self) -> None:
        """Release the run, whether or not it ended."""


class RunLogger(Protocol):
    """The slot's interface. Every method may block and may raise, since no run ever waits for a logger.

    An implementation must be picklable, since it works in a separate process.

    Attributes:
        name: the option's name.
    """

    name: str

    @property
    def place(self) -> str:
        """Where the logger shows runs: an address or a folder."""

    def has(self, run_id: str) -> bool:
        """Return whether the logger shows a run with that id."""

    def begin(self, facts: RunFacts, points: Sequence[CurvePoint]) -> Shown:
        """Show a run with exactly these facts and points, replacing whatever the logger had of it."""

    def sweep(self, facts: SweepFacts) -> None:
        """Show a sweep as a group that contains its runs; a second call changes nothing."""


class Busy(Exception):
    """Raised when another process is showing the run in that logger."""


class Session:
    """The work of showing one run in one logger, from the run's beginning to its end.

    Args:
        logger: the logger.
        run: the run, which has begun.
        ledgers: the folder of notes about what loggers have.

    Raises:
        Busy: if another process is showing the run in that logger.
    """

    def __init__(self, logger: RunLogger, run: Run, ledgers: Path):
        self.logger, self.run = logger, run
        ledgers.mkdir(parents=True, exist_ok=True)
        self.ledger = ledgers / f"{run.id}.json"
        self.lock = FileLock(ledgers / f"{run.id}.lock")
        self.shown: Shown | None = None
        try:
            self.lock.acquire(timeout=0)
        except Timeout:
            raise Busy(f"run {run.id} is shown by another process") from None

    def step(self) -> None:
        """Show what is new in a run that goes on."""
        if not self.run.manifest_path.exists():
            return  # it is about to begin
        with self._trying():
            if self.shown is None:
                self._begin(facts_of(self.run, running=True))
            elif points := self.tail.read():
                self.shown.log(points)

    def end(self) -> None:
        """Show the run's final state from its folder, and note that this logger has it."""
        if not self.run.manifest_path.exists():
            return  # it never began
        with self._trying():
            facts = facts_of(self.run)
            if self.shown is None or self._outdated(facts):
                self._begin(facts)
            assert self.shown is not None
            while points := self.tail.read():
                self.shown.log(points)
            if self.tail.repeated:  # loggers can't take back what the run logged before it was resumed
                self._begin(facts)
            mark = fingerprint(self.run, facts)
            self.shown.end(facts, final(facts, self.run.step))
            write_json(self.ledger, {"shown": mark})

    def up_to_date(self) -> bool:
        """Return whether the logger has everything of the run already."""
        kept = read_json(self.ledger).get("shown")
        return kept == fingerprint(self.run, facts_of(self.run)) and self.logger.has(self.run.id)

    def leave(self) -> None:
        """Release the run."""
        try:
            if self.shown is not None:
                shown, self.shown = self.shown, None
                shown.leave()
        finally:
            self.lock.release()

    def _begin(self, facts: RunFacts) -> None:
        self.ledger.unlink(missing_ok=True)
        if self.shown is not None:
            shown, self.shown = self.shown, None
            shown.leave()
        self.tail, self.results = Tail(self.run), facts.results
        self.shown = self.logger.begin(facts, self.tail.history())

    def _outdated(self, facts: RunFacts) -> bool:
        """Return whether a result was measured again since the run began to be shown, with another value."""
        return any(facts.results.get(key) != value for key, value in self.results.items())

    @contextlib.contextmanager
    def _trying(self) -> Iterator[None]:
        """Start anew after a failure, since it is unknown how much the logger received."""
        try:
            yield
        except BaseException:
            shown, self.shown = self.shown, None
            if shown is not None:
                with contextlib.suppress(Exception):
                    shown.leave()
            raise
