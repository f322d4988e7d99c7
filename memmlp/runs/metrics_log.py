"""A run's metrics log: an append-only file with one JSON line for each record."""

from __future__ import annotations

import errno
import json
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from memmlp.common.errors import InputError
from memmlp.common.files import atomic_write, make_json_safe
from memmlp.common.lease import check_owner


class LogRecord(NamedTuple):
    """One record of the log.

    Attributes:
        step: the number of finished training steps.
        phase: "train" or "val".
        values: values by name.
        time: seconds since 1970, UTC.
    """

    step: int
    phase: str
    values: dict[str, float]
    time: float


def parse_record(line: bytes) -> LogRecord:
    """Parse a line of the log. Raises ValueError, KeyError or TypeError if it is not a record."""
    entry = json.loads(line)
    values = {key: float(value) for key, value in entry["values"].items()}
    return LogRecord(entry["step"], entry["phase"], values, entry["time"])


class MetricsLog:
    """The file `metrics.jsonl` of a run."""

    def __init__(self, path: Path):
        self.path = path
        self._whole = False

    def append(self, step: int, values: Mapping[str, float], phase: str) -> None:
        """Append one line in a single write, so that a kill can damage only this line.

        Raises:
            LeaseLost: if another process has taken over the run.
            OSError: if the disk is full; the log is then unchanged.
        """
        check_owner(self.path)
        if not self._whole:
            self.repair()
        entry = {"step": step, "phase": phase, "time": round(time.time(), 3), "values": dict(values)}
        line = json.dumps(make_json_safe(entry), allow_nan=False).encode() + b"\n"
        with open(self.path, "ab", buffering=0) as file:
            check_owner(self.path)  # check again: `repair` of the next owner replaces the file
            self._whole = False
            if file.write(line) < len(line):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.path))
            self._whole = True

    def repair(self) -> None:
        """Replace the log by a copy without an incomplete last line.

        Later writes of an earlier owner go to the old file and are lost.
        """
        if self.path.exists():
            content = self.path.read_bytes()
            atomic_write(self.path, content[: content.rfind(b"\n") + 1])
        self._whole = True

    def read(self) -> list[LogRecord]:
        """Return all records, without an incomplete last line.

        If a resumed run repeated a step, the last record of the step is returned.

        Raises:
            InputError: if a line is damaged; the message names file and line.
        """
        if not self.path.exists():
            return []
        entries: dict[tuple[str, int], LogRecord] = {}
        for number, line in enumerate(self.path.read_bytes().split(b"\n")[:-1], 1):
            try:
                metrics = parse_record(line)
            except (ValueError, KeyError, TypeError):
                raise InputError(
                    f"{self.path}: line {number} is damaged; remove it, or repeat the run with force=true"
                ) from None
            entries[metrics.phase, metrics.step] = metrics
        return list(entries.values())
