"""Garbage collection, ends, imports of children, and the share of a core."""

from __future__ import annotations

import gc
import os
import signal
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest
from processes import finished

import memmlp
from memmlp.cli.main import main
from memmlp.common import processes
from memmlp.common.processes import (
    GC_THRESHOLDS,
    children_import_the_same,
    finish_uninterrupted,
    import_environment,
    termination_interrupts,
)
from memmlp.sweep.executors.slurm import Requeued

FILE = "import memmlp; print(memmlp.__file__)"


@pytest.fixture
def foreign(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with another copy of the package, which a child without our environment imports."""
    (tmp_path / "memmlp").mkdir()
    (tmp_path / "memmlp" / "__init__.py").write_text("")
    monkeypatch.chdir(tmp_path)
    assert Path(found()) == tmp_path / "memmlp" / "__init__.py"
    return tmp_path


def found(**environment: str) -> str:
    """The package's file that a child imports."""
    line = [sys.executable, "-c", FILE]
    answer = subprocess.run(line, env=os.environ | environment, capture_output=True, text=True, check=True)
    return answer.stdout.strip()


def test_a_import_environment_the_same_package(foreign: Path):
    assert found(**import_environment()) == memmlp.__file__


def test_another_interpreter_keeps_its_own_library(foreign: Path):
    """One of another version that a job starts on its way would not work with this one's."""
    paths = import_environment()["PYTHONPATH"].split(os.pathsep)
    assert str(Path(memmlp.__file__).parents[1]) in paths
    assert not [path for path in paths if path.startswith(sysconfig.get_path("stdlib"))]


def test_so_it_does_within_the_context_alone(foreign: Path):
    with children_import_the_same():
        assert found() == memmlp.__file__
    assert found() != memmlp.__file__


def test_what_lies_in_the_working_folder_is_found_where_this_process_finds_it(
    foreign: Path, monkeypatch: pytest.MonkeyPatch
):
    """As after `python -c`, whose first path is empty."""
    monkeypatch.setattr(sys, "path", ["", *sys.path])
    assert Path(found(**import_environment())) == foreign / "memmlp" / "__init__.py"


COMMAND = """
import atexit, gc, sys
from memmlp.cli.main import main

atexit.register(lambda: print(gc.get_threshold(), gc.get_freeze_count() > 0))  # called after what comes later
sys.argv = ["memmlp", "--version"]
main()
"""


def test_a_command_of_its_own_process():
    said = finished([sys.executable, "-c", COMMAND]).stdout.splitlines()
    assert said[-1] == f"{GC_THRESHOLDS} True"


def test_a_worker():
    before = gc.get_threshold()
    gc.set_threshold(1000, 1, 1)
    try:
        assert Requeued(lambda: str(gc.get_threshold()))() == str(GC_THRESHOLDS)
    finally:
        gc.set_threshold(*before)


def test_a_command_line_that_python_calls_leaves_it_alone(capsys):
    before = gc.get_threshold()
    gc.set_threshold(1000, 1, 1)
    try:
        main(["--version"])
        assert gc.get_threshold() == (1000, 1, 1)
    finally:
        gc.set_threshold(*before)


def test_an_end_that_has_begun_is_not_interrupted():
    ended = []

    def end() -> None:
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGTERM)
        ended.append(True)

    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with pytest.raises(KeyboardInterrupt), finish_uninterrupted(end):
        raise KeyboardInterrupt
    assert ended
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


def test_a_request_to_end_is_a_ctrl_c():
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt), termination_interrupts():
        signal.raise_signal(signal.SIGTERM)
    assert signal.getsignal(signal.SIGTERM) == before


def test_a_share_by_clocks_of_the_tests_own(monkeypatch: pytest.MonkeyPatch):
    clocks = {"perf_counter": 100.0, "thread_time": 3.0}
    for name in clocks:
        monkeypatch.setattr(processes.time, name, lambda name=name: clocks[name])
    clock = processes.CoreClock()
    clocks |= {"perf_counter": 108.0, "thread_time": 5.0}
    assert clock.share == 0.25
