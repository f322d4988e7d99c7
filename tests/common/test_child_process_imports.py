"""Other Python processes find the package that this one does, and not one in the working folder."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

import memmlp
from memmlp.common.child_process_imports import child_imports, children_import_the_same

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


def test_a_child_imports_the_same_package(foreign: Path):
    assert found(**child_imports()) == memmlp.__file__


def test_another_interpreter_keeps_its_own_library(foreign: Path):
    """One of another version that a job starts on its way would not work with this one's."""
    paths = child_imports()["PYTHONPATH"].split(os.pathsep)
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
    assert Path(found(**child_imports())) == foreign / "memmlp" / "__init__.py"
