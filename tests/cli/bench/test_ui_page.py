"""`memmlp bench ui` makes run folders that the page reads without damage."""

from __future__ import annotations

from pathlib import Path

import pytest

from memmlp.cli.bench import ui_page
from memmlp.report.ui.index import Index


@pytest.mark.slow
def test_the_command(memmlp, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(ui_page.shutil, "which", lambda name: None)
    ran = memmlp("bench", "ui", "--runs", "6", "--lines", "4")
    assert ran.code == 0, ran.err
    assert ran.out.startswith("6 runs of 4 lines, made in ")
    assert "page: not timed, as Chromium is not installed" in ran.out


@pytest.mark.slow
def test_its_runs_are_whole(tmp_path: Path):
    ui_page.make(tmp_path, 6, 4)
    index = Index(tmp_path)
    index.refresh()
    assert {(run["status"], *run["damage"]) for run in index.runs.values()} == {("done",)}
    assert {run["config"]["memory.name"] for run in index.runs.values()} == set(ui_page.MEMORIES)
    assert all(run["metrics"]["stream.rotation.MPJPE"] > 6 for run in index.runs.values())
    assert {run["recent"][-1][0] for run in index.runs.values()} == {40}
