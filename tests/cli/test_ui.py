"""`memmlp ui` opens its page, and refuses what it can't serve, in one line."""

from unittest.mock import Mock

import pytest
from conftest import Memmlp, one_line


@pytest.mark.parametrize(("words", "told"), [
    (["--token", "a token of many letters"], "--token: "),
    (["--host", "0.0.0.0", "--token", "short"], "--token: must have at least 16"),
    (["--port", "65536"], "range"), (["--host", "nowhere.invalid"], "--host nowhere.invalid --port 8787"),
])  # fmt: skip
def test_what_is_refused(memmlp: Memmlp, words: list[str], told: str):
    assert one_line(memmlp("ui", "--no-browser", *words), told)


def test_it_opens_its_page_and_ends_with_ctrl_c(memmlp: Memmlp, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("webbrowser.open", opened := Mock(side_effect=KeyboardInterrupt))
    monkeypatch.setattr("memmlp.cli.ui.threading", None)  # where it would wait without a page
    ran = memmlp("ui", "--port", "0")
    assert (ran.code, ran.out.split()[0]) == (0, opened.call_args.args[0])
