"""A logger in memory that can fail or hang, and runs to show in it."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from memmlp.runs.evaluation_file import write_report
from memmlp.runs.identity import hash_evaluation_settings
from memmlp.runs.loggers.logger import CurvePoint, RunFacts
from memmlp.runs.run import Run


@dataclass
class Server:
    """The content of a server, which refuses if `down`, and disconnects after values if it `drops`."""

    down: bool = False
    drops: bool = False
    gate: threading.Event | None = None  # a logger hangs until it is set
    status: dict[str, str] = field(default_factory=dict)
    values: dict[str, list[tuple[str, int, float]]] = field(default_factory=dict)
    results: dict[str, list[str]] = field(default_factory=dict)
    fingerprints: dict[str, str] = field(default_factory=dict)
    begun: int = 0

    def ask(self) -> None:
        """Refuse while the server is down."""
        if self.gate:
            self.gate.wait()
        if self.down:
            raise ConnectionError("connection refused")


class FakeLogger:
    place = "memory"

    def __init__(self, server: Server | None = None, name: str = "fake"):
        self.server, self.name = server or Server(), name

    def fingerprint(self, run_id: str) -> str | None:
        self.server.ask()
        return self.server.fingerprints.get(run_id)

    def begin(self, facts: RunFacts, points: Sequence[CurvePoint]) -> FakeShown:
        self.server.ask()
        self.server.begun += 1
        self.server.status[facts.id] = facts.status
        self.server.values[facts.id] = []
        self.server.fingerprints.pop(facts.id, None)
        shown = FakeShown(self.server, facts.id)
        shown.log(points)
        return shown


class FakeShown:
    def __init__(self, server: Server, run_id: str):
        self.server, self.run_id = server, run_id

    def log(self, points: Sequence[CurvePoint]) -> None:
        self.server.ask()
        self.server.values[self.run_id] += [(p.key, p.step, p.value) for p in points]
        if self.server.drops:
            self.server.drops = False
            raise ConnectionError("connection reset")

    def end(self, facts: RunFacts) -> None:
        self.server.ask()
        self.server.status[facts.id] = facts.status
        self.server.results[facts.id] = [point.key for point in facts.results]
        self.server.fingerprints[facts.id] = facts.fingerprint

    def close(self) -> None:
        """Nothing."""


def a_run(outputs: Path, name: str = "0" * 16, steps: int = 3, **config: object) -> Run:
    run = Run.from_id(outputs, name)
    run.begin("memmlp", {"seed": 0, **config}, data="d" * 64, prerequisite=None, stages=[])
    for step in range(1, steps + 1):
        run.log(step, {"loss": 1 / step})
    return run


def losses(steps: int) -> list[tuple[str, int, float]]:
    return [("train/loss", step, 1 / step) for step in range(1, steps + 1)]


def an_outdated_evaluation(run: Run) -> Path:
    """Write an evaluation of an earlier component version, and return its file."""
    settings = {"mode": "stream", "ik": "off"}
    path = run.evaluation(hash_evaluation_settings(settings))
    versions = {"mode.stream": 0}
    write_report(
        path,
        {"mode": "stream", "settings": settings, "mean": {}, "clips": [], "component_versions": versions},
    )
    return path
