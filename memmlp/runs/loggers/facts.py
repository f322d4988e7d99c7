"""What loggers show of runs, read from their folders alone."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

from memmlp.common.files import digest, file_digest, plain, read_json
from memmlp.runs.deployment_folder import with_times_as_deployed
from memmlp.runs.evaluation_file import with_solvers
from memmlp.runs.identity import flatten
from memmlp.runs.lookup import run_name
from memmlp.runs.metrics_log import parsed
from memmlp.runs.notes import read_notes
from memmlp.runs.run import Run

ORIGIN = ("kind", "data", "prerequisite", "started", "version", "user", "host", "device", "gpu", "threads")


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
        results: its results by name, as points at the last training step.
        outdated: which results are by earlier component versions, with what has changed since; else empty.
        files: the small files that are worth showing.
        fingerprint: a digest of everything that a logger shows of the run, with its curves.
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
    results: tuple[CurvePoint, ...]
    outdated: str
    files: tuple[Path, ...]
    fingerprint: str = ""

    @property
    def texts(self) -> dict[str, str]:
        """The facts that a reader should see as text: status, reason of a failure, outdated results."""
        texts = {"status": self.status, "reason": self.reason or "", "outdated results": self.outdated}
        return {name: text for name, text in texts.items() if text}


def read_run(run: Run, running: bool = False) -> RunFacts:
    """Read the facts of a run that has started.

    Args:
        run: the run.
        running: whether a process works on it; if not, its end is read from the folder.
    """
    manifest, config, notes = run.manifest, run.config, read_notes(run)
    failure, finished = read_json(run.folder / "FAILED"), manifest.get("finished")
    status = "running" if running else "failed" if failure else "done" if run.complete else "killed"
    records = run.metrics()
    started = _seconds(manifest.get("started"))
    ended = _seconds(failure.get("when") or finished) or max((one.time for one in records), default=started)
    evaluations, deployed = run.evaluations_as_configured, run.deployment_shown(config)
    results = flatten(with_solvers(with_times_as_deployed(run.results), evaluations.combined_by))
    step = max((record.step for record in records), default=0)
    git = manifest.get("git") or {}
    origin = {name: manifest.get(name) for name in ORIGIN}
    origin |= {"commit": git.get("commit"), "changed since the commit": git.get("dirty")}
    files = (
        run.config_path, run.results_path, run.picture, run.folder / "code.patch",
        deployed.onnx, deployed.latency,
    )  # fmt: skip
    facts = RunFacts(
        id=run.id,
        name=run_name(manifest, flatten(config)),
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
            for key, value in results.items()
            if _is_number(value)
        ),
        outdated="; ".join(f"{mode} ({changes})" for mode, changes in evaluations.outdated.items()),
        files=tuple(path for path in files if path.is_file()),
    )
    digests = [file_digest(path) for path in (run.metrics_path, *facts.files) if path.exists()]
    return replace(facts, fingerprint=digest([plain(asdict(facts)), digests]))


class Tail:
    """Reads a run's metrics log: at first all lines so far, then the lines added since.

    Attributes:
        repeated: whether an added line was of a step that was read before, as of a run that was resumed.
    """

    def __init__(self, run: Run):
        self.path, self.offset, self.repeated = run.metrics_path, 0, False
        self.last: dict[str, int] = {}  # the last step of each phase

    def read(self) -> list[CurvePoint]:
        """Return the values of the new lines; of a step that is repeated in them, the last ones."""
        if not self.path.exists():
            return []
        with open(self.path, "rb") as file:
            file.seek(self.offset)
            content = file.read()
        content = content[: content.rfind(b"\n") + 1]  # the last line may be incomplete
        self.offset += len(content)
        records = {(record.phase, record.step): record for record in map(parsed, content.splitlines())}
        self.repeated |= any(step <= self.last.get(phase, -1) for phase, step in records)
        for phase, step in records:
            self.last[phase] = max(step, self.last.get(phase, 0))
        return [
            CurvePoint(f"{record.phase}/{key}", value, record.step, record.time)
            for record in records.values()
            for key, value in record.values.items()
        ]


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _seconds(moment: str | None) -> float:
    return datetime.fromisoformat(moment).timestamp() if moment else 0.0
