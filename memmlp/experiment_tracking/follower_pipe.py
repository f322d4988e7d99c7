"""A run's side of tracking: it sends events to the process that follows the run, and never waits for it."""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from memmlp.common.child_process_imports import child_imports
from memmlp.experiment_tracking.run_logger import RunLogger
from memmlp.runs.run import Run

SHARE = 0.01  # of a run's time, for which its end may be waited for
MOST = 10.0  # seconds of that at most


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
        """Show a run, which has begun, for the duration of the context, and then its end or failure.

        This never fails: at worst there is a line on stderr.
        """
        feed, begun = feed_of(self), time.monotonic()
        feed.tell("begin", run.folder)
        try:
            yield
        finally:
            feed.tell("end", run.folder)
            feed.wait(run.folder, min(SHARE * (time.monotonic() - begun), MOST))

    def sweep(self, folder: Path, seconds: float = MOST) -> None:
        """Show a sweep's runs as one group, read from its folder; wait at most `seconds` for it."""
        feed = feed_of(self)
        feed.tell("sweep", folder)
        feed.wait(folder, seconds)


class Feed:
    """The pipe to a process that shows runs. No method blocks for long or raises.

    Attributes:
        dropped: how many events were dropped, because the process is gone or its pipe is full.
    """

    def __init__(self, tracking: Loggers):
        self.dropped = 0
        self.names = [logger.name for logger in tracking.loggers]
        self.answers: dict[tuple[str, str], str] = {}
        self.answered = threading.Condition()
        self.process = self._start(tracking) if tracking.loggers else None

    def _start(self, tracking: Loggers) -> subprocess.Popen[bytes] | None:
        environment = os.environ | child_imports() | {"OMP_NUM_THREADS": "1"}
        given = {
            "loggers": pickle.dumps(tracking.loggers),
            "outputs": str(tracking.outputs.absolute()),
        }
        try:
            log = tracking.outputs / "tracking" / "follower.log"
            log.parent.mkdir(parents=True, exist_ok=True)
            with open(log, "ab") as errors:
                process = subprocess.Popen(
                    [sys.executable, "-m", "memmlp.experiment_tracking.follower"],
                    stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors,
                    start_new_session=True, env=environment,
                )  # fmt: skip
            assert process.stdin is not None
            assert process.stdout is not None
            process.stdin.write(pickle.dumps(given))
            process.stdin.flush()
            os.set_blocking(process.stdin.fileno(), False)
        except OSError as error:
            warn(f"runs are not shown by {', '.join(self.names)}: {error}")
            return None
        self.listener = threading.Thread(target=self._listen, args=(process.stdout,), daemon=True)
        self.listener.start()
        return process

    @property
    def alive(self) -> bool:
        """Whether the process is alive."""
        return self.process is not None and self.process.poll() is None

    def tell(self, event: str, folder: Path) -> None:
        """Send the process an event. A line that it can't take at once is dropped and counted."""
        if self.process is None:
            return
        assert self.process.stdin is not None
        where = str(folder.absolute())
        for name in self.names:
            self.answers.pop((where, name), None)
        line = json.dumps({"event": event, "folder": where}).encode() + b"\n"
        try:
            if os.write(self.process.stdin.fileno(), line) < len(line):  # the kernel takes a short one whole
                raise BlockingIOError
        except OSError:
            self.dropped += 1
            warn(f"the {event} of {folder.name} is not shown: its follower does not listen")

    def wait(self, folder: Path, seconds: float) -> bool:
        """Wait, at most `seconds`, until all loggers have shown or missed a run's end; return whether so."""
        wanted = [(str(folder.absolute()), name) for name in self.names]
        with self.answered:
            return self.answered.wait_for(
                lambda: not self.alive or all(one in self.answers for one in wanted), seconds
            )

    def close(self) -> None:
        """Let the process end after it has shown everything that it was told."""
        if self.process is not None and self.process.stdin is not None:
            with contextlib.suppress(OSError):
                self.process.stdin.close()

    def _listen(self, answers: IO[bytes]) -> None:
        """Read the process's answers until it ends."""
        with contextlib.suppress(ValueError, OSError), answers:
            for line in answers:
                answer = json.loads(line)
                with self.answered:
                    self._take(answer)
                    self.answered.notify_all()
        with self.answered:
            self.answered.notify_all()

    def _take(self, answer: dict[str, str]) -> None:
        logger, what = answer["logger"], Path(answer["folder"]).name
        if answer["event"] in ("shown", "missed"):
            self.answers[answer["folder"], logger] = answer["event"]
        if answer["event"] == "trouble":
            warn(f"{what} is not shown by {logger} at present: {answer['reason']}")
        elif answer["event"] == "missed":
            warn(f"{logger} lacks {what}: {answer['reason']}; memmlp loggers sync fills it in")
        elif answer["event"] == "dropped":
            warn(f"{logger} was too slow for {answer['reason']} events; memmlp loggers sync fills them in")


_FEEDS: dict[Loggers, Feed] = {}
"""The feeds of this process; the processes behind them end with it."""


def feed_of(tracking: Loggers) -> Feed:
    """Return this process' feed for these loggers; a new one if its process has died."""
    feed = _FEEDS.get(tracking)
    if feed is not None and tracking.loggers and not feed.alive:
        feed.close()
        feed = None
    if feed is None:
        feed = _FEEDS[tracking] = Feed(tracking)
    return feed


def warn(line: str) -> None:
    """Print a line to stderr, if there is one."""
    with contextlib.suppress(OSError, ValueError):
        print(f"memmlp: warning: {line}", file=sys.stderr, flush=True)
