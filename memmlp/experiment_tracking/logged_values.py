"""What loggers show: facts and points, all read from the folders of runs and sweeps."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import sys
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

from memmlp.common.files import file_digest, plain, read_json
from memmlp.runs.deployment_folder import with_times_as_deployed
from memmlp.runs.evaluation_file import with_solvers
from memmlp.runs.identity import flatten
from memmlp.runs.metrics_log import LogRecord, parsed
from memmlp.runs.notes import read_notes
from memmlp.runs.run import Run
from memmlp.runs.shown_name import run_name

SYSTEM = "system.jsonl"
"""The log of the machine's load during a run, in the run's folder."""


class CurvePoint(NamedTuple):
    """A value of a curve.

    Attributes:
        key: the curve's name, PHASE/NAME.
        value: the value, possibly NaN.
        step: the training step.
        time: seconds since 1970, UTC.
    """

    key: str
    value: float
    step: int
    time: float


@dataclass(frozen=True)
class RunFacts:
    """The facts in a run's folder, besides its curves.

    Attributes:
        id: the run's id.
        name: the run's readable name.
        folder: the run's folder.
        status: "running", "done", "failed" or "killed".
        reason: why it failed; None if it did not.
        started, ended: seconds since 1970; `ended` is None while it runs.
        config: the run's config by dotted key, as text.
        origin: facts about its origin, by name.
        tags: the tags that users gave it.
        note: the users' note; empty for none.
        data: name and digest of its data.
        results: its results by name, as curves of one point.
        earlier: which of these are by earlier recipes, with what has changed since; else empty.
        files: the small files that are worth showing.
    """

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
    results: Mapping[str, float]
    earlier: str
    files: tuple[Path, ...]

    @property
    def title(self) -> str:
        """The name with the beginning of the id, which distinguishes runs with the same name."""
        return f"{self.name} · {self.id[:8]}"


def facts_of(run: Run, running: bool = False) -> RunFacts:
    """Read the facts of a begun run.

    Args:
        run: the run.
        running: whether a process works on it; if not, its end is read from the folder.
    """
    manifest, config, notes = run.manifest, run.config, read_notes(run)
    status = "running" if running else _status(run)
    evaluations, deployed = run.evaluations_as_configured, run.deployment_shown(config)
    results = flatten(with_solvers(with_times_as_deployed(run.results), evaluations.combined_by))
    started = _seconds(manifest.get("started"))
    own = (
        run.config_path, run.results_path, run.picture, run.folder / "code.patch",
        deployed.onnx, deployed.latency,
    )  # fmt: skip
    return RunFacts(
        id=run.id,
        name=run_name(manifest, flatten(config)),
        folder=run.folder.absolute(),
        status=status,
        reason=run.failure if status == "failed" else None,
        started=started,
        ended=None if status == "running" else _ended(run, started),
        config={key: str(value) for key, value in flatten(config).items()},
        origin=_origin(manifest),
        tags=notes.tags,
        note=notes.note,
        data=(str((config.get("data") or {}).get("name") or "data"), str(manifest.get("data"))),
        results={k.replace(".", "/"): float(v) for k, v in results.items() if _number(v)},
        earlier="; ".join(f"{mode} ({changes})" for mode, changes in evaluations.outdated.items()),
        files=tuple(path for path in own if path.is_file()),
    )


def _status(run: Run) -> str:
    """Return the status of a run on which no process works: failed, done (see `Run.complete`), or killed."""
    if run.failure:
        return "failed"
    return "done" if run.complete else "killed"


def _ended(run: Run, started: float) -> float:
    """Return when the run finished or failed, or else the time of its last line in the log."""
    when = read_json(run.folder / "FAILED").get("when") or run.manifest.get("finished")
    return _seconds(when) if when else max((entry.time for entry in run.metrics()), default=started)


def _origin(manifest: Mapping[str, Any]) -> dict[str, str]:
    """Return the manifest's facts about the run's origin, as far as they are known."""
    git = manifest.get("git") or {}
    names = ("kind", "data", "upstream", "started", "version", "user", "host", "device", "gpu", "threads")
    tags = {name: manifest.get(name) for name in names}
    tags |= {"commit": git.get("commit"), "changed since the commit": git.get("dirty")}
    return {name: str(value) for name, value in tags.items() if value is not None}


def points(entry: LogRecord) -> Iterator[CurvePoint]:
    """Yield the values of one record of a metrics log."""
    for key, value in entry.values.items():
        yield CurvePoint(f"{entry.phase}/{key}", value, entry.step, entry.time)


def final(facts: RunFacts, step: int) -> list[CurvePoint]:
    """Return the results as points at the last training step."""
    time = facts.ended or facts.started
    return [CurvePoint(key, value, step, time) for key, value in facts.results.items()]


def fingerprint(run: Run, facts: RunFacts) -> str:
    """Return a digest of everything that a logger shows of the run."""
    logs = [file_digest(path) for path in (run.metrics_path, run.folder / SYSTEM) if path.exists()]
    files = [file_digest(path) for path in facts.files]
    text = json.dumps(plain([asdict(facts), logs, files]), sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


class Tail:
    """Reads a run's logs: first all lines so far, then added lines, a limited number at a time.

    Attributes:
        repeated: whether an added line was of a step that was read before, as of a run that was resumed.
    """

    MOST = 1000

    def __init__(self, run: Run):
        self.places = {run.metrics_path: 0, run.folder / SYSTEM: 0}
        self.steps: dict[str, int] = {}  # the last one of each phase
        self.repeated = False

    def history(self) -> list[CurvePoint]:
        """Return all values so far; if a resumed run repeated a step, its last values."""
        entries = {(entry.phase, entry.step): entry for entry in self._entries(sys.maxsize)}
        for phase, step in entries:
            self.steps[phase] = max(step, self.steps.get(phase, 0))
        return [point for entry in entries.values() for point in points(entry)]

    def read(self) -> list[CurvePoint]:
        """Return the values of lines that were added since the last call."""
        found: list[CurvePoint] = []
        for entry in self._entries(self.MOST):
            self.repeated |= entry.step <= self.steps.get(entry.phase, -1)
            self.steps[entry.phase] = max(entry.step, self.steps.get(entry.phase, 0))
            found += points(entry)
        return found

    def _entries(self, most: int) -> Iterator[LogRecord]:
        for path in filter(Path.exists, self.places):
            with open(path, "rb") as file:
                file.seek(self.places[path])
                for line in itertools.islice(file, most):
                    if not line.endswith(b"\n"):  # it is being written
                        break
                    self.places[path] += len(line)
                    yield parsed(line)


@dataclass(frozen=True)
class SweepFacts:
    """The facts in a sweep's folder.

    Attributes:
        name: the name of its folder, which differs between command lines of one sweep file.
        folder: the sweep's folder.
        status: "running", "stopped" (unfinished, and nobody is at it), "done" or "failed".
        arms: run id -> the label of its arm.
        aggregates: means over seeds, by LABEL/MODE/METRIC.
        verdicts: verdicts on differences from the controls, by LABEL/MODE/METRIC.
        files: the sweep's table as Markdown and HTML.
    """

    name: str
    folder: Path
    status: str
    arms: Mapping[str, str]
    aggregates: Mapping[str, float]
    verdicts: Mapping[str, str]
    files: tuple[Path, ...]

    RECORD = "summary.json"

    @classmethod
    def read(cls, folder: Path) -> SweepFacts | None:
        """Read a sweep's facts; None if its folder has none."""
        found = read_json(folder / cls.RECORD)
        if not {"name", "status", "labels", "aggregates", "verdicts"} <= found.keys():
            return None
        files = tuple(path for path in (folder / "table.md", folder / "table.html") if path.is_file())
        own = {name: found[name] for name in ("status", "verdicts")}
        own["aggregates"] = {key: value for key, value in found["aggregates"].items() if _number(value)}
        return cls(folder.name, folder.absolute(), arms=found["labels"], files=files, **own)


def _number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _seconds(moment: str | None) -> float:
    return datetime.fromisoformat(moment).timestamp() if moment else 0.0
