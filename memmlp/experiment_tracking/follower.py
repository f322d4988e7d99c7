"""The process beside a run that shows it in loggers.

Lines on its standard input tell it which runs begin and end. It reads the content from the runs' own folders,
so a run never waits for a logger, and a slow logger loses nothing. Each logger has its own thread and
bounded inbox. A logger that fails is tried again after longer and longer pauses; `memmlp loggers sync` fills
in what it missed in the end.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import pickle
import queue
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from memmlp.experiment_tracking.logged_values import SYSTEM, SweepFacts
from memmlp.experiment_tracking.run_logger import Busy, RunLogger, Session
from memmlp.experiment_tracking.system import Machine, next_sample
from memmlp.runs.metrics_log import MetricsLog
from memmlp.runs.run import Run

PACE = 1.0  # seconds between looks at a run's log
SLOWEST = 60.0  # seconds of the longest pause after failures
GRACE = 30.0  # seconds in which a logger may take the end of a run
SAMPLE = 10.0  # seconds between measurements of the machine
INBOX = 100  # events of runs that a logger may be behind

Event = dict[str, str]
Tell = Callable[[Event], None]


class Followed:
    """A run that one logger shows, with the state of its failures.

    Attributes:
        run: the run.
        ended: when its end was announced (monotonic seconds); None while it goes on.
        next: when to look at it next.
    """

    def __init__(self, run: Run):
        self.run = run
        self.session: Session | None = None
        self.ended: float | None = None
        self.failures, self.next = 0, 0.0

    def failed(self, now: float) -> None:
        """Postpone the next try, for longer the more often it has failed."""
        self.failures += 1
        pause = min(PACE * 2**self.failures, SLOWEST)
        self.next = now + (min(pause, 2 * PACE) if self.ended is not None else pause)

    def late(self, now: float) -> bool:
        """Return whether the run ended so long ago that the logger should give up on it."""
        return self.ended is not None and now - self.ended > GRACE


class Desk:
    """The runs that one logger shows, in a thread of its own.

    Args:
        logger: the logger.
        ledgers: the folder of notes about what the logger has.
        tell: gets a report of runs that were shown to their end, of failures and of dropped events.
    """

    def __init__(self, logger: RunLogger, ledgers: Path, tell: Tell):
        self.logger, self.ledgers, self.tell = logger, ledgers, tell
        self.inbox: queue.Queue[Event] = queue.Queue(INBOX)
        self.runs: dict[str, Followed] = {}
        self.dropped = 0
        self.thread = threading.Thread(target=self._work, daemon=True)

    def put(self, event: Event) -> None:
        """Hand over an event; if the inbox is full, the event is dropped and counted."""
        try:
            self.inbox.put_nowait(event)
        except queue.Full:
            self.dropped += 1

    def _work(self) -> None:
        """Work until the event "stop" has come and every run has been shown or given up."""
        stopping = False
        while not stopping or self.runs:
            for event in self._arrived():
                if event["event"] == "stop":
                    stopping = True
                    self._end_all()
                else:
                    self.take(event)
            self.look(time.monotonic())

    def _arrived(self) -> list[Event]:
        """Return the events that have arrived, after waiting for at most PACE."""
        found = []
        with contextlib.suppress(queue.Empty):
            found.append(self.inbox.get(timeout=PACE))
            while True:
                found.append(self.inbox.get_nowait())
        return found

    def take(self, event: Event) -> None:
        """Register a run's beginning or end, or show a sweep."""
        folder = event["folder"]
        if event["event"] == "sweep":
            self._sweep(Path(folder))
        elif event["event"] == "begin":
            self._leave(folder)
            self.runs[folder] = Followed(Run(folder))
        elif event["event"] == "end":
            one = self.runs.setdefault(folder, Followed(Run(folder)))
            one.ended, one.next = time.monotonic(), 0.0

    def _end_all(self) -> None:
        """Mark all runs as ended, because the process that worked on them is gone."""
        for one in self.runs.values():
            if one.ended is None:
                one.ended, one.next = time.monotonic(), 0.0

    def look(self, now: float) -> None:
        """Show what is new in every run that is due."""
        for folder, one in list(self.runs.items()):
            if now < one.next:
                continue
            try:
                self._show(one)
            except Busy:
                one.next = now + PACE
                self._give_up(folder, one, now, "another process shows it")
            except Exception as error:
                one.failed(now)
                reason = reason_of(error)
                if one.failures == 1:
                    self._say("trouble", folder, reason)
                self._give_up(folder, one, now, reason)

    def _show(self, one: Followed) -> None:
        if one.session is None:
            one.session = Session(self.logger, one.run, self.ledgers)
        if one.ended is None:
            one.session.step()
        else:
            one.session.end()
            self._close(str(one.run.folder), "shown", "")
        one.failures = 0

    def _give_up(self, folder: str, one: Followed, now: float, reason: str) -> None:
        if one.late(now):
            self._close(folder, "missed", reason)

    def _close(self, folder: str, event: str, reason: str) -> None:
        self._leave(folder)
        self._say(event, folder, reason)

    def _leave(self, folder: str) -> None:
        one = self.runs.pop(folder, None)
        if one is not None and one.session is not None:
            with contextlib.suppress(Exception):
                one.session.leave()

    def _sweep(self, folder: Path) -> None:
        try:
            facts = SweepFacts.read(folder)
            if facts is not None:
                self.logger.sweep(facts)
            self._say("shown", str(folder), "")
        except Exception as error:
            self._say("missed", str(folder), reason_of(error))

    def _say(self, event: str, folder: str, reason: str) -> None:
        self.tell({"event": event, "logger": self.logger.name, "folder": folder, "reason": reason})


class MachineLog:
    """Appends measurements of the machine to the logs of the running runs."""

    def __init__(self, pid: int):
        self.machine = Machine(pid)
        self.logs: dict[str, tuple[MetricsLog, int]] = {}

    def take(self, event: Event) -> None:
        """Register a run's beginning or end."""
        folder = event.get("folder", "")
        if event["event"] == "begin":
            self.logs[folder] = (MetricsLog(Path(folder) / SYSTEM), next_sample(Run(folder)))
        else:
            self.logs.pop(folder, None)

    def sample(self) -> None:
        """Append a measurement to each log."""
        values = self.machine.measure() if self.logs else {}
        for folder, (log, number) in list(self.logs.items()):
            with contextlib.suppress(OSError):  # the folder was removed, or its disk is full
                if values and Path(folder).is_dir():
                    log.append(number, values, "system")
                    self.logs[folder] = (log, number + 1)


def reason_of(error: BaseException) -> str:
    """Return an error as a short line."""
    return " ".join(str(error).split())[:200] or type(error).__name__


def ledgers(outputs: Path, logger: RunLogger) -> Path:
    """Return the folder of notes about what a logger has of the runs in an outputs folder."""
    place = hashlib.sha256(logger.place.encode()).hexdigest()[:8]
    return outputs / "tracking" / f"{logger.name}-{place}"


def follow(
    loggers: Sequence[RunLogger], outputs: Path, pid: int, told: queue.Queue[Event], tell: Tell
) -> None:
    """Follow runs until the event "stop" comes, and then finish showing them, for at most GRACE.

    Args:
        loggers: where to show the runs.
        outputs: the outputs folder.
        pid: the process that works on the runs.
        told: the events.
        tell: gets reports of the outcome of events.
    """
    desks = [Desk(logger, ledgers(outputs, logger), tell) for logger in loggers]
    sampler, sampled = MachineLog(pid), time.monotonic()
    for desk in desks:
        desk.thread.start()
    event: Event = {}
    while event.get("event") != "stop":
        try:
            event = told.get(timeout=PACE)
        except queue.Empty:
            event = {"event": "stop"} if os.getppid() != pid else {}
        if event:
            sampler.take(event)
            for desk in desks:
                desk.put(event)
        if time.monotonic() - sampled >= SAMPLE:
            sampler.sample()
            sampled = time.monotonic()
    end = time.monotonic() + GRACE
    for desk in desks:
        desk.thread.join(max(end - time.monotonic(), 0))
        if desk.dropped:
            tell({"event": "dropped", "logger": desk.logger.name, "folder": "", "reason": str(desk.dropped)})


def main() -> None:
    """Read the loggers, then events from the standard input; write the outcomes to the standard output."""
    with contextlib.suppress(OSError):
        os.nice(10)  # a run goes before what shows it
    given: dict[str, Any] = pickle.load(sys.stdin.buffer)  # from the process that started this one
    loggers, outputs = pickle.loads(given["loggers"]), Path(given["outputs"])
    out, lock = os.fdopen(os.dup(1), "w"), threading.Lock()
    os.dup2(2, 1)  # what packages print is not taken for an answer

    def tell(event: Event) -> None:
        with lock, contextlib.suppress(OSError, ValueError):
            print(json.dumps(event), file=out, flush=True)

    told: queue.Queue[Event] = queue.Queue(INBOX)

    def listen() -> None:
        for line in sys.stdin.buffer:
            with contextlib.suppress(ValueError):  # a line that a full pipe cut
                told.put(json.loads(line))
        told.put({"event": "stop"})

    threading.Thread(target=listen, daemon=True).start()
    follow(loggers, outputs, os.getppid(), told, tell)
    os._exit(0)  # a thread that hangs in a logger holds up nothing


if __name__ == "__main__":
    main()
