"""Processes that tests start, which end with the tests, however those end."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

T = TypeVar("T")

MARK = "MEMMLP_TESTS"
PATIENCE = 900.0  # seconds until a wait fails: nothing comes near, on a machine with much other work either
PROC = Path("/proc")


def mark() -> None:
    """Set the environment variable by which the processes are found that this one starts.

    Those that they start in turn inherit it, in whatever session: a sweep's workers among them. The mark of
    a test process begins with that of the one that distributes the tests, which so finds all.
    """
    os.environ[MARK] = f"{os.environ.get(MARK, '')}/{uuid.uuid4().hex}"


def marked() -> list[int]:
    """The numbers of the living processes with this process' mark, without itself.

    None where there is no /proc. The resource tracker of multiprocessing ends with this process.
    """
    wanted = f"{MARK}={os.environ[MARK]}".encode()
    found = []
    for folder in PROC.glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it has ended, or is somebody else's
            begins = any(entry.startswith(wanted) for entry in (folder / "environ").read_bytes().split(b"\0"))
            if begins and b"resource_tracker" not in (folder / "cmdline").read_bytes():
                found.append(int(folder.name))
    return [pid for pid in found if pid != os.getpid()]


def end_all() -> None:
    """Kill the processes with this process' mark, and what they start meanwhile."""
    end = time.monotonic() + PATIENCE
    while pids := marked():
        assert time.monotonic() < end, f"processes {pids} do not end"
        for pid in pids:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        time.sleep(0.01)


@contextlib.contextmanager
def started(line: Sequence[str], **options: Any) -> Iterator[subprocess.Popen]:
    """A process, with `subprocess.Popen`'s options, that is killed at the end if it has not ended."""
    with subprocess.Popen(line, **options) as process:
        try:
            yield process
        finally:
            process.kill()


@contextlib.contextmanager
def ignoring_interrupts() -> Iterator[None]:
    """As in what nohup started: processes started herein ignore SIGINT, if they do nothing about it."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def finished(line: Sequence[str], **options: Any) -> subprocess.CompletedProcess[str]:
    """What a process left that has ended by itself."""
    return subprocess.run(line, capture_output=True, text=True, check=False, timeout=PATIENCE, **options)


def until(condition: Callable[[], T], what: str, process: subprocess.Popen | None = None) -> T:
    """The first true value of a condition; fails where `process`, if one is given, ends without it."""
    end = time.monotonic() + PATIENCE
    while True:
        ended = process is not None and process.poll() is not None  # before the condition is looked at
        if value := condition():
            return value
        assert not ended, f"the process ended with {process.returncode} before {what}"
        assert time.monotonic() < end, f"not within {PATIENCE:.0f} s: {what}"
        time.sleep(0.03)
