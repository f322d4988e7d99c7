"""A run's metrics log: an append-only file with one JSON line for each record."""

import errno
import functools
import json
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from memmlp.common.errors import InputError
from memmlp.common.files import atomic_write, make_json_safe
from memmlp.common.lease import check_owner
from memmlp.common.schema import check_type, parse_json
from memmlp.runs.records import LogEntry

MAX_BYTES = 64 * 2**20
TAIL_BYTES = 2**12  # searched for recent records


class LogRecord(NamedTuple):
    """One record of the log, after `step` finished training steps. `phase` is "train", "val" or "system"
    (CPU and memory); `time` is seconds since 1970, UTC."""

    step: int
    phase: str
    values: dict[str, float]
    time: float


def parse_record(line: bytes) -> LogRecord:
    """Parse a line of the log. Raises ValueError if it is not a record."""
    entry = parse_json(line)
    check_type(entry, LogEntry)
    values = {key: float(value) for key, value in entry["values"].items()}
    return LogRecord(entry["step"], entry["phase"], values, entry["time"])


@functools.lru_cache(16)
def _read_tail(path: Path, *stamp: int) -> tuple[LogRecord, ...]:
    log = MetricsLog(path)
    content = log.read_bytes(-TAIL_BYTES)
    return tuple(log.parse(content.partition(b"\n")[2] if len(content) == TAIL_BYTES else content))


@functools.lru_cache(20_000)
def _find_damage(path: Path, *stamp: int) -> str | None:
    try:
        _read_tail(path, *stamp)
    except InputError as error:
        return str(error)
    return None


class MetricsLog:
    """The file `metrics.jsonl` of a run."""

    def __init__(self, path: Path):
        self.path = path
        self._whole = False

    def append(self, step: int, values: Mapping[str, float], phase: str) -> None:
        """Append one line in a single write, so that a kill can damage only this line. Raises LeaseLost if
        another process has taken over the run, and OSError if the disk is full; the log is then unchanged."""
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
        """Replace the log by a copy without an incomplete last line. Later writes of an earlier owner go to
        the old file and are lost."""
        if self.path.exists():
            content = self.read_bytes()
            atomic_write(self.path, content[: content.rfind(b"\n") + 1])
        self._whole = True

    def read(self) -> list[LogRecord]:
        """Return all records, without an incomplete last line. If a resumed run repeated a step, the step's
        last record is returned. Raises InputError if a line is damaged; the message names file and line."""
        return list({(one.phase, one.step): one for one in self.parse(self.read_bytes())}.values())

    def read_tail(self) -> list[LogRecord]:
        """Return the records in the last TAIL_BYTES. Raises InputError like `read`."""
        return list(_read_tail(self.path, *self._stamp))

    def find_damage(self) -> str | None:
        """Return the error of `read_tail` as text, or None. An unchanged log is not read again."""
        return _find_damage(self.path, *self._stamp)

    @property
    def _stamp(self) -> tuple[int, ...]:
        try:
            found = self.path.stat()
        except OSError:
            return ()
        return found.st_mtime_ns, found.st_size

    def read_bytes(self, start: int = 0) -> bytes:
        """Return the log's content from a byte on, or the last bytes if `start` is negative. Raises
        InputError if the log is not a regular file, or too large."""
        if not self.path.exists():
            return b""
        if not self.path.is_file() or (size := self.path.stat().st_size) > MAX_BYTES:
            raise InputError(f"{self.path}: must be a file of at most {MAX_BYTES} bytes")
        with open(self.path, "rb") as file:
            file.seek(max(size + start, 0) if start < 0 else start)
            return file.read(MAX_BYTES)

    def parse(self, content: bytes) -> list[LogRecord]:
        """Return the records in complete lines. Raises InputError like `read`."""
        found = []
        for number, line in enumerate(content.split(b"\n")[:-1], 1):
            try:
                found.append(parse_record(line))
            except ValueError as error:
                where = f"line {number}" if len(content) != TAIL_BYTES else "a line near its end"
                raise InputError(
                    f"{self.path}: {where} is damaged ({error}); remove it, or repeat the run with force=true"
                ) from None
        return found
