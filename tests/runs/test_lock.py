"""A run is held by one process, and freed by its death."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from begun_runs import begun
from processes import started

from memmlp.runs.run import Run

HOLD = """
import sys, time
from memmlp.runs.run import Run
from memmlp.tables.measured_run import load
with Run(sys.argv[1]).lock():
    print("held", flush=True)
    sys.stdin.read()
"""


@contextlib.contextmanager
def holding(run: Run) -> Iterator[subprocess.Popen]:
    """A process that holds the run until its input ends."""
    line = [sys.executable, "-c", HOLD, str(run.folder)]
    with started(line, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        assert holder.stdout.readline() == b"held\n"
        yield holder


def test_another_process_waits_and_says_for_whom(tmp_path: Path):
    run = begun(tmp_path)
    said: list[str] = []
    with holding(run) as holder:

        def waiting(line: str) -> None:
            said.append(line)
            holder.stdin.close()  # only now it lets go

        with run.lock(waiting):
            assert len(said) == 1
    assert f"process {holder.pid} since" in said[0]


def test_a_killed_holder_frees_the_lock(tmp_path: Path):
    run = begun(tmp_path)
    with holding(run) as holder:
        holder.kill()
        holder.wait()
        said: list[str] = []
        with run.lock(said.append):
            assert said == []
