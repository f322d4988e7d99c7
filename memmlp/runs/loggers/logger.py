"""Shows runs in loggers while they are in progress, by threads that read the runs' folders.

The metrics log on disk is the queue between a run and its loggers. So the run never waits for a logger, and
no data is lost if a logger is slow or fails. `memmlp loggers sync` adds missing data later."""

import contextlib
import math
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import NamedTuple, Protocol

from memmlp.common.files import digest, file_digest, is_number, make_json_safe
from memmlp.common.overrides import flatten
from memmlp.runs import records
from memmlp.runs.lookup import get_run_name, read_notes
from memmlp.runs.metrics_log import MetricsLog, parse_record
from memmlp.runs.run import Run

ORIGIN = ("kind", "data", "prerequisite", "started", "version", "user", "host", "device", "gpu", "threads")


class CurvePoint(NamedTuple):
    """A point of the curve `key` (PHASE/NAME); `time` is seconds since 1970, UTC."""

    key: str
    value: float
    step: int
    time: float


@dataclass(frozen=True)
class RunFacts:
    """All facts about a run that loggers show, without its curves. `status` is "running", "done", "failed" or
    "killed"; times are seconds since 1970; `ended` is None while it runs. `config` and `origin` are texts by
    key. `results` are points at the last training step. `outdated` names modes with changed component
    versions. `fingerprint` is a digest of everything that loggers show, including curves."""

    id: str
    name: str
    folder: Path
    status: str
    reason: str | None
    started: float
    ended: float | None
    config: Mapping[str, str]
    origin: Mapping[str, str]
    tags: tuple[str, ...]
    note: str
    data: tuple[str, str]
    results: tuple[CurvePoint, ...]
    outdated: str
    files: tuple[Path, ...]
    fingerprint: str = ""

    @property
    def texts(self) -> dict[str, str]:
        """The facts to show as text: status, reason of a failure, outdated results."""
        texts = {"status": self.status, "reason": self.reason or "", "outdated results": self.outdated}
        return {name: text for name, text in texts.items() if text}


def read_run_facts(run: Run, running: bool = False) -> RunFacts:
    """Read the facts of a run that has started, and its final state if it has ended."""
    run.check_records()
    manifest, config, notes = run.manifest, run.config, read_notes(run)
    failure, finished = records.read(run.folder / "FAILED", records.Failure), manifest.get("finished")
    status = "running" if running else "failed" if failure else "done" if run.complete else "killed"
    log = run.metrics()
    started = _parse_time(manifest.get("started"))
    ended = _parse_time(failure.get("when") or finished) or max((one.time for one in log), default=started)
    evaluations, deployed = run.configured_evaluations, run.find_shown_deployment(config)
    step = max((record.step for record in log), default=0)
    git = manifest.get("git") or {}
    origin = {name: manifest.get(name) for name in ORIGIN}
    origin |= {"commit": git.get("commit"), "changed since the commit": git.get("dirty")}
    files = (
        run.config_path, run.results_path, run.picture, run.folder / "code.patch",
        deployed.onnx, deployed.latency,
    )  # fmt: skip
    facts = RunFacts(
        id=run.id,
        name=get_run_name(manifest, flatten(config)),
        folder=run.folder.absolute(),
        status=status,
        reason=failure.get("reason") if not running else None,
        started=started,
        ended=None if running else ended,
        config={key: str(value) for key, value in flatten(config).items()},
        origin={name: str(value) for name, value in origin.items() if value is not None},
        tags=notes.tags,
        note=notes.note,
        data=(str((config.get("data") or {}).get("name") or "data"), str(manifest.get("data"))),
        results=tuple(
            CurvePoint(key.replace(".", "/"), float(value), step, ended)
            for key, value in run.flat_results.items()
            if is_number(value) and math.isfinite(value)
        ),
        outdated="; ".join(f"{mode} ({changes})" for mode, changes in evaluations.outdated.items()),
        files=tuple(path for path in files if path.is_file()),
    )
    digests = [file_digest(path) for path in (run.metrics_path, *facts.files) if path.exists()]
    return replace(facts, fingerprint=digest([make_json_safe(asdict(facts)), digests]))


class LogReader:
    """Reads new lines of a run's metrics log. `repeated` is set once a resumed run has logged a step
    again."""

    def __init__(self, run: Run):
        self.log, self.offset, self.repeated = MetricsLog(run.metrics_path), 0, False
        self.last: dict[str, int] = {}  # the last step of each phase

    def read(self) -> list[CurvePoint]:
        """Return the values of new lines; for a repeated step, only its last values."""
        content = self.log.read_bytes(self.offset)
        content = content[: content.rfind(b"\n") + 1]  # the last line may be incomplete
        self.offset += len(content)
        found = {(record.phase, record.step): record for record in map(parse_record, content.splitlines())}
        self.repeated |= any(step <= self.last.get(phase, -1) for phase, step in found)
        for phase, step in found:
            self.last[phase] = max(step, self.last.get(phase, 0))
        return [
            CurvePoint(f"{record.phase}/{key}", value, record.step, record.time)
            for record in found.values()
            for key, value in record.values.items()
        ]


def _parse_time(moment: str | None) -> float:
    return datetime.fromisoformat(moment).timestamp() if moment else 0.0


PACE = 1.0  # seconds between two reads of a run's log
MAX_PAUSE = 60.0  # maximum seconds before a failed logger is tried again
MAX_WAIT = 30.0  # maximum seconds that a run waits for its loggers at its end


class ShownRun(Protocol):
    """A run in a logger. Every method may block and may raise."""

    def log(self, points: Sequence[CurvePoint]) -> None:
        """Show new points of the curves."""

    def end(self, facts: RunFacts) -> None:
        """Show the run's final state: status, results, files and fingerprint. This is the last update."""

    def close(self) -> None:
        """Release all resources; this may happen before the run's end."""


class RunLogger(Protocol):
    """The interface of loggers; `name` is the option's name. Every method may block and may raise."""

    name: str

    @property
    def place(self) -> str:
        """The address or folder where the logger shows runs."""

    def fingerprint(self, run_id: str) -> str | None:
        """Return the fingerprint that `ShownRun.end` stored for a run; None if its end is missing."""

    def begin(self, facts: RunFacts, points: Sequence[CurvePoint]) -> ShownRun:
        """Show a run with these facts and points; all earlier data of the run in the logger is replaced."""


class Session:
    """Shows one run in one logger, from the run's start to its end."""

    def __init__(self, logger: RunLogger, run: Run):
        self.logger, self.run = logger, run
        self.shown: ShownRun | None = None

    def update(self) -> None:
        """Show new points of a run in progress."""
        with self._close_on_failure():
            if self.shown is None:
                if self.run.manifest_path.exists():
                    self._begin(read_run_facts(self.run, running=True))
            elif points := self.tail.read():
                self.shown.log(points)

    def end(self) -> None:
        """Show the run's final state."""
        if not self.run.manifest_path.exists():
            return  # the run never started
        with self._close_on_failure():
            facts = read_run_facts(self.run)
            shown = self.shown or self._begin(facts)
            if points := self.tail.read():
                shown.log(points)
            if self.tail.repeated:  # loggers can't remove points that were logged before the run was resumed
                shown = self._begin(facts)
            shown.end(facts)
        self.close()

    def close(self) -> None:
        """Release all resources."""
        shown, self.shown = self.shown, None
        if shown is not None:
            shown.close()

    def _begin(self, facts: RunFacts) -> ShownRun:
        self.close()
        self.tail = LogReader(self.run)
        self.shown = self.logger.begin(facts, self.tail.read())
        return self.shown

    @contextlib.contextmanager
    def _close_on_failure(self) -> Iterator[None]:
        """Close the run after a failure, since the logger may have received only a part of the data."""
        try:
            yield
        except BaseException:
            with contextlib.suppress(Exception):
                self.close()
            raise


@contextlib.contextmanager
def show_run(run: Run, loggers: Sequence[RunLogger]) -> Iterator[None]:
    """Show a run during the context, then its final state. A logger never stops the run: if it fails, a
    warning goes to stderr; if it is slow, the run waits at its end for at most MAX_WAIT."""
    ended = threading.Event()
    arguments = [(Session(logger, run), ended) for logger in loggers]
    threads = [threading.Thread(target=_show_until_end, args=one, daemon=True) for one in arguments]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        ended.set()
        latest = time.monotonic() + MAX_WAIT
        for logger, thread in zip(loggers, threads, strict=True):
            thread.join(max(latest - time.monotonic(), 0))
            if thread.is_alive():
                _warn(f"run {run.id} is not shown in {logger.name}: the logger is too slow")


def _show_until_end(session: Session, ended: threading.Event) -> None:
    """Show a run until its end. After a failure, warn once and try again with growing pauses."""
    pause, failed, has_ended = 0.0, False, False
    while not has_ended:
        has_ended = ended.wait(pause)
        try:
            if has_ended:
                session.end()
            else:
                session.update()
            pause = PACE
        except Exception as error:
            if not failed:
                _warn(f"run {session.run.id} is not shown in {session.logger.name}: {_format_error(error)}")
            failed, pause = True, min(2 * pause or PACE, MAX_PAUSE)


def _warn(line: str) -> None:
    with contextlib.suppress(OSError, ValueError):
        print(f"memmlp: warning: {line}; run memmlp loggers sync to add it", file=sys.stderr, flush=True)


def _format_error(error: BaseException) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__


def sync_runs(logger: RunLogger, runs: Iterable[Run], report: Callable[[str], None]) -> Counter[str]:
    """Update a logger with the content of each run's folder; `report` gets a line about each failure. Return
    how many runs were "shown", up to date ("same"), in progress ("live", skipped) and "failed"."""
    counts: Counter[str] = Counter()
    for run in runs:
        try:
            if run.activity:
                counts["live"] += 1
            elif logger.fingerprint(run.id) == read_run_facts(run).fingerprint:
                counts["same"] += 1
            else:
                Session(logger, run).end()
                counts["shown"] += 1
        except Exception as error:
            counts["failed"] += 1
            report(f"run {run.id} is not shown in {logger.name}: {_format_error(error)}")
    return counts
