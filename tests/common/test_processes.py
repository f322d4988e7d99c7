"""Garbage collection, ends, imports of children, and the share of a core."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import memmlp
from memmlp.common.processes import (
    build_import_variables,
    finish_uninterrupted,
    treat_termination_as_interrupt,
)

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
    line = [sys.executable, "-c", FILE]
    answer = subprocess.run(line, env=os.environ | environment, capture_output=True, text=True, check=True)
    return answer.stdout.strip()


def test_a_import_environment_the_same_package(foreign: Path):
    assert found(**build_import_variables()) == memmlp.__file__


def test_an_end_that_has_begun_is_not_interrupted_and_a_request_to_end_is_a_ctrl_c():
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
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt), treat_termination_as_interrupt():
        signal.raise_signal(signal.SIGTERM)
    assert signal.getsignal(signal.SIGTERM) == before
