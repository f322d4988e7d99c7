"""Loggers for tests: one in memory that can be down, one that writes a file or hangs in another process."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from memmlp.experiment_tracking.logged_values import CurvePoint, RunFacts, SweepFacts
from memmlp.runs.evaluation_file import write_report
from memmlp.runs.identity import evaluation_id_of
from memmlp.runs.run import Run


@dataclass
class Server:
    """What a server has; `down` makes it refuse, `drops` makes it take values and then break the line."""

    down: bool = False
    drops: bool = False
    status: dict[str, str] = field(default_factory=dict)
    values: dict[str, list[tuple[str, int, float]]] = field(default_factory=dict)
    results: dict[str, list[str]] = field(default_factory=dict)
    sweeps: list[str] = field(default_factory=list)
    begun: int = 0

    def ask(self) -> None:
        """Refuse while the server is down."""
        if self.down:
            raise ConnectionError("connection refused")


class FakeLogger:
    """A logger in memory."""

    name = "fake"
    place = "memory"

    def __init__(self, server: Server | None = None):
        self.server = server or Server()

    def has(self, run_id: str) -> bool:
        """Whether the server has the run."""
        self.server.ask()
        return run_id in self.server.status

    def begin(self, facts: RunFacts, points: Sequence[CurvePoint]) -> FakeShown:
        """Show it anew."""
        self.server.ask()
        self.server.begun += 1
        self.server.status[facts.id] = facts.status
        self.server.values[facts.id] = []
        shown = FakeShown(self.server, facts.id)
        shown.log(points)
        return shown

    def sweep(self, facts: SweepFacts) -> None:
        """Count it."""
        self.server.ask()
        self.server.sweeps.append(facts.name)


class FakeShown:
    """A run in memory."""

    def __init__(self, server: Server, run_id: str):
        self.server, self.run_id = server, run_id

    def log(self, points: Sequence[CurvePoint]) -> None:
        """Add to what the server has."""
        self.server.ask()
        self.server.values[self.run_id] += [(p.key, p.step, p.value) for p in points]
        if self.server.drops:
            self.server.drops = False
            raise ConnectionError("connection reset")

    def end(self, facts: RunFacts, results: Sequence[CurvePoint]) -> None:
        """Note how it ended."""
        self.server.ask()
        self.server.status[facts.id] = facts.status
        self.server.results[facts.id] = [point.key for point in results]

    def leave(self) -> None:
        """Nothing."""


@dataclass(frozen=True)
class FileLogger:
    """Writes lines into a file, from whatever process; with `hangs` it never comes back from a beginning."""

    path: Path
    hangs: bool = False

    name = "file"

    @property
    def place(self) -> str:
        """The file."""
        return str(self.path)

    def has(self, run_id: str) -> bool:
        """Whether the file speaks of the run."""
        return self.path.exists() and run_id in self.path.read_text()

    def begin(self, facts: RunFacts, points: Sequence[CurvePoint]) -> FileLogger:
        """Write that it begins."""
        if self.hangs:
            threading.Event().wait()
        self._write(f"begin {facts.id} {facts.status}")
        self.log(points)
        return self

    def log(self, points: Sequence[CurvePoint]) -> None:
        """Write values, those of training."""
        for point in points:
            if point.key.startswith("train"):
                self._write(f"{point.key} {point.step} {point.value:g}")

    def end(self, facts: RunFacts, results: Sequence[CurvePoint]) -> None:
        """Write how it ended."""
        self._write(f"end {facts.id} {facts.status}")

    def leave(self) -> None:
        """Nothing."""

    def sweep(self, facts: SweepFacts) -> None:
        """Write its name."""
        self._write(f"sweep {facts.name}")

    def _write(self, line: str) -> None:
        with open(self.path, "a") as file:
            file.write(line + "\n")


def a_run(outputs: Path, name: str = "0" * 16, steps: int = 3, **config: object) -> Run:
    """A begun run with some steps."""
    run = Run.of(outputs, name)
    run.begin("memmlp", {"seed": 0, **config}, data="d" * 64, upstream=None, stages=[])
    for step in range(1, steps + 1):
        run.log(step, {"loss": 1 / step})
    return run


def losses(steps: int) -> list[tuple[str, int, float]]:
    """What a logger has of a run's steps."""
    return [("train/loss", step, 1 / step) for step in range(1, steps + 1)]


def an_outdated_evaluation(run: Run) -> Path:
    """Write an evaluation by an earlier recipe, and return its file."""
    settings = {"mode": "stream", "ik": "off"}
    path = run.evaluation(evaluation_id_of(settings))
    recipes = {"mode.stream": 0}
    write_report(path, {"mode": "stream", "settings": settings, "mean": {}, "clips": [], "recipes": recipes})
    return path
