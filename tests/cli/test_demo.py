"""`memmlp demo` says what it does where no terminal shows progress bars."""

from __future__ import annotations

import pytest
from command_line import TINY

from memmlp.cli.demo import tell
from memmlp.common.progress import stage_begins, telling_stages


@pytest.mark.slow
def test_each_stage_has_a_line_without_a_terminal(memmlp):
    ran = memmlp("demo", *TINY)
    assert ran.code == 0
    stages = [line.partition(":")[0] for line in ran.err.splitlines()]
    assert stages == ["data", "VQ-VAE", "network", "evaluation", "deployment"]
    assert "the demo took" in ran.out


@pytest.mark.parametrize(("terminal", "said"), [(True, ""), (False, "data: once\n")])
def test_a_terminal_has_its_progress_bars_alone(capsys, monkeypatch: pytest.MonkeyPatch, terminal, said):
    monkeypatch.setattr("sys.stderr.isatty", lambda: terminal, raising=False)
    tell("data: once")
    assert capsys.readouterr().err == said


def test_lines_are_told_to_who_listens_alone():
    told: list[str] = []
    stage_begins("data: before")
    with telling_stages(told.append):
        stage_begins("data: within")
    stage_begins("data: after")
    assert told == ["data: within"]
