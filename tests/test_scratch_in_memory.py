"""Temporary files of tests are in memory where there is plenty, and nothing is left there."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import pytest
from scratch_in_memory import NAME, scratch_in_memory


@pytest.fixture(autouse=True)
def _own_place(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setenv("TMPDIR", "anywhere")  # so that what is changed is put back
    monkeypatch.delenv("TMPDIR")


def test_files_are_there_from_now_on(tmp_path: Path):
    scratch = scratch_in_memory(tmp_path, 1)
    assert scratch == tmp_path / f"{NAME}{os.getpid()}"
    assert tempfile.gettempdir() == os.environ["TMPDIR"] == str(scratch)


def test_what_is_left_of_dead_processes_goes_and_nothing_else(tmp_path: Path):
    dead, alive, foreign = (tmp_path / f"{NAME}{end}" for end in ("4194305", os.getppid(), "notes"))
    for folder in (dead, alive, foreign):
        folder.mkdir()
    scratch_in_memory(tmp_path, 1)
    assert [folder.exists() for folder in (dead, alive, foreign)] == [False, True, True]


def test_where_there_is_little_or_none_or_another_place_they_stay(tmp_path: Path, monkeypatch):
    assert scratch_in_memory(tmp_path, 2**62) is None
    assert scratch_in_memory(tmp_path / "none", 1) is None
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    assert scratch_in_memory(tmp_path, 1) is None
    assert not any(tmp_path.iterdir())
