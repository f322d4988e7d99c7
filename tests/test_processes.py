"""What tests start ends with them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import processes
import pytest
from processes import end_all, forked, marked, started, until

from memmlp.runs import environment

# A process that ignores interrupts, and starts one like itself in a session of its own.
STUBBORN = """
import signal, subprocess, sys, time
signal.signal(signal.SIGINT, signal.SIG_IGN)
signal.signal(signal.SIGTERM, signal.SIG_IGN)
if sys.argv[1:]:
    subprocess.Popen([sys.executable, "-c", sys.argv[1]], start_new_session=True)
time.sleep(6000)
"""


@pytest.fixture
def own(monkeypatch: pytest.MonkeyPatch) -> None:
    """A mark that is this test's alone."""
    monkeypatch.setenv(processes.MARK, "")
    processes.mark()


def ended(pid: int) -> bool:
    """Whether there is no such process, or nothing of it but its exit code."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


@pytest.mark.usefixtures("own")
def test_all_that_a_test_started_ends(tmp_path: Path):
    """What it started, what that started in another session, and what a killed one left."""
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
    assert left != process.pid
    end_all()
    assert ended(left)


def test_a_process_ends_however_its_test_does():
    with pytest.raises(AssertionError), started([sys.executable, "-c", STUBBORN]) as process:
        raise AssertionError
    assert process.returncode == -signal.SIGKILL


def test_a_wait_fails_when_its_process_has_ended_or_in_the_end(monkeypatch: pytest.MonkeyPatch):
    with (
        started([sys.executable, "-c", "raise SystemExit(3)"]) as process,
        pytest.raises(AssertionError, match="ended with 3 before it works"),
    ):
        until(lambda: False, "it works", process)
    monkeypatch.setattr(processes, "PATIENCE", 0.01)
    with pytest.raises(AssertionError, match="not within 0 s: it works"):
        until(lambda: False, "it works")


def told(path: Path) -> None:
    """Write down what a forked process finds done, its search path, and a variable."""
    done = environment._package_code.cache_info().currsize
    path.write_text(f"{done} {os.environ.get('PYTHONPATH')} {os.environ.get('MEMMLP_OUTPUTS')}")


def test_a_forked_process_finds_done_what_each_would_do_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """And the environment as it was before any test: processes of many tests are forked off one server."""
    before = os.environ.get("PYTHONPATH")
    monkeypatch.setenv("PYTHONPATH", "elsewhere")
    monkeypatch.setenv("MEMMLP_OUTPUTS", "elsewhere")
    with forked(told, tmp_path / "told") as process:
        assert process.wait() == 0
    assert (tmp_path / "told").read_text() == f"1 {before} {processes.BEGUN.get('MEMMLP_OUTPUTS')}"
