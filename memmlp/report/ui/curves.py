"""Curves of runs: metrics logs read as they grow, thinned out to what a screen can show."""

from __future__ import annotations

import math
import threading
from collections import defaultdict
from pathlib import Path
from typing import Any

from memmlp.report.ui.run_row import parsed_line

MOST = 400  # about how many points a curve has at most


class Log:
    """A metrics log, of which only new lines are read again."""

    def __init__(self, path: Path):
        self.path = path
        self._forget()

    def _forget(self) -> None:
        self.read, self.first, self.bad = 0, b"", 0
        self.series: dict[str, dict[int, float]] = defaultdict(dict)

    def update(self) -> None:
        """Read the appended lines, or the whole file if it was replaced by another one."""
        try:
            with open(self.path, "rb") as file:
                first = file.readline()
                size = file.seek(0, 2)
                if size < self.read or first[: len(self.first)] != self.first:
                    self._forget()
                self.first = first if first.endswith(b"\n") else b""
                file.seek(self.read)
                new = file.read()
        except OSError:
            return
        whole = new.rfind(b"\n") + 1
        self.read += whole
        for line in new[:whole].splitlines():
            self._add(line)

    def _add(self, line: bytes) -> None:
        entry = parsed_line(line)
        if entry is None:
            self.bad += 1
            return
        for name, value in entry["values"].items():
            self.series[f"{entry['phase']} {name}"][entry["step"]] = value


class Curves:
    """The curves of all runs of an outputs folder."""

    def __init__(self, outputs: Path):
        self.outputs = outputs
        self.logs: dict[str, Log] = {}
        self.lock = threading.Lock()

    def of(self, run_id: str, names: list[str] | None = None) -> dict[str, Any]:
        """Return a run's curves by name, such as "train loss": [steps, values]; None is a missing number."""
        with self.lock:
            log = self.logs.setdefault(run_id, Log(self.outputs / "runs" / run_id / "metrics.jsonl"))
            log.update()
            wanted = log.series if names is None else [name for name in names if name in log.series]
            return {name: thinned(log.series[name]) for name in wanted}


def thinned(points: dict[int, float], most: int = MOST) -> list[list[Any]]:
    """Return steps and values; of many, only the smallest and the largest in each stretch."""
    pairs = sorted(points.items())
    if len(pairs) > most:
        size = math.ceil(2 * len(pairs) / most)
        kept = {0, len(pairs) - 1}
        for start in range(0, len(pairs), size):
            stretch = range(start, min(start + size, len(pairs)))
            kept |= {
                min(stretch, key=lambda i: _order(pairs[i][1])),
                max(stretch, key=lambda i: _order(pairs[i][1])),
            }
        pairs = [pairs[i] for i in sorted(kept)]
    return [[step for step, _ in pairs], [_rounded(value) for _, value in pairs]]


def _order(value: float) -> float:
    return value if math.isfinite(value) else math.inf


def _rounded(value: float) -> float | None:
    return float(f"{value:.5g}") if math.isfinite(value) else None
