"""What is said of long work where no terminal shows bars."""

import re

import pytest

from memmlp.common import progress
from memmlp.common.progress import notify, print_announcements


@pytest.mark.parametrize("terminal", [True, False])
def test_a_remark_is_shown_on_a_terminal_too(capsys, monkeypatch: pytest.MonkeyPatch, terminal):
    monkeypatch.setattr("sys.stderr.isatty", lambda: terminal, raising=False)
    notify("data: before")
    with print_announcements():
        notify("data: 1 file was skipped")
    assert capsys.readouterr().err == "data: 1 file was skipped\n"


def test_long_work_tells_how_far_it_is_by_unit_and_stage(capsys, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(progress, "INTERVAL", 0.0)
    with print_announcements(), progress.show_progress("network", 4000, done=398) as count:
        count.advance()
        count.set_note("loss 2.31")
        count.advance()
    first, second = capsys.readouterr().err.splitlines()
    assert first.startswith("network: 399 of 4000")
    assert re.fullmatch(r"network: 400 of 4000, loss 2\.31(, \d+ (s|min) left)?", second)
    with print_announcements():
        with progress.label_progress("validation"):
            list(progress.progress_bar(iter("a"), "stream", unit="frames"))
        list(progress.progress_bar(iter("a"), "stream", unit="frames"))
    assert capsys.readouterr().err.splitlines() == ["validation, stream: 1 frames", "stream: 1 frames"]
