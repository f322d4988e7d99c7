"""What every test shares."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import pytest

from memmlp.cli.main import main


class Ran(NamedTuple):
    """A command's exit code and what it wrote."""

    code: int
    out: str
    err: str


Memmlp = Callable[..., Ran]


@pytest.fixture(autouse=True)
def _own_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    """No test depends on the caller's settings, or writes to its outputs."""
    for name in (
        "MEMMLP_OUTPUTS",
        "MEMMLP_TRACEBACK",
        "MLFLOW_TRACKING_URI",
        "HYDRA_FULL_ERROR",
        "COMP_LINE",
    ):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("COLUMNS", "80")


@pytest.fixture
def memmlp(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Memmlp:
    """Run `memmlp ARGUMENTS` in this process, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["memmlp"])

    def run(*arguments: str) -> Ran:
        capsys.readouterr()
        code = 0
        try:
            main(list(arguments))
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
        return Ran(code, *capsys.readouterr())

    return run


def one_line(ran: Ran, *words: str) -> bool:
    """Whether the command refused its input in one line on stderr that has these words, and exit code 2."""
    line = re.fullmatch(r"memmlp: [^\n]+\n", ran.err)
    return ran.code == 2 and ran.out == "" and line is not None and all(word in ran.err for word in words)
