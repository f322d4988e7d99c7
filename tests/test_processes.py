"""Processes that a test starts end with it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import processes
import pytest
from processes import end_all, marked, started, until

# A process that ignores interrupts, and starts another one in its own session.
STUBBORN = """
import signal, subprocess, sys, time
signal.signal(signal.SIGINT, signal.SIG_IGN)
signal.signal(signal.SIGTERM, signal.SIG_IGN)
if sys.argv[1:]:
    subprocess.Popen([sys.executable, "-c", sys.argv[1]], start_new_session=True)
time.sleep(6000)
"""


def ended(pid: int) -> bool:
    """Whether there is no such process, or only its exit code."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


def test_all_processes_end(monkeypatch: pytest.MonkeyPatch):
    """Also those in another session, and those of a killed process."""
    monkeypatch.setenv(processes.MARK, "here")
    processes.mark()
    with subprocess.Popen([sys.executable, "-c", STUBBORN, STUBBORN]) as process:
        until(lambda: len(marked()) == 2, "both are there", process)
        pids = marked()
        assert process.pid in pids
        assert os.getpid() not in pids
        end_all()
    until(lambda: all(ended(pid) for pid in pids), "they have ended")
    assert process.returncode == -signal.SIGKILL
    with started([sys.executable, "-c", STUBBORN, STUBBORN]) as process:
        until(lambda: len(marked()) == 2, "both are there", process)
    (left,) = marked()
    end_all()
    assert ended(left)


def test_until_fails_when_its_process_ends_or_time_is_up(monkeypatch: pytest.MonkeyPatch):
    with (
        started([sys.executable, "-c", "raise SystemExit(3)"]) as process,
        pytest.raises(AssertionError, match="ended with 3 before it works"),
    ):
        until(lambda: False, "it works", process)
    monkeypatch.setattr(processes, "PATIENCE", 0.01)
    with pytest.raises(AssertionError, match="not within 0 s: it works"):
        until(lambda: False, "it works")
