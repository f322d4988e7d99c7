"""`memmlp ui` opens its page, and refuses what it can't serve, in one line."""

from signal import SIGINT, raise_signal
from urllib.request import urlopen

import pytest
from conftest import Memmlp, one_line


@pytest.mark.parametrize(("words", "told"), [
    (["--token", "a token of many letters"], "--token: "),
    (["--host", "0.0.0.0", "--token", "short"], "--token: must have at least 16"),
    (["--port", "65536"], "--port"), (["--host", "nowhere.invalid"], "--host nowhere.invalid --port 8787"),
])  # fmt: skip
def test_what_is_refused(memmlp: Memmlp, words: list[str], told: str):
    assert one_line(memmlp("ui", "--no-browser", *words), told)


def test_it_opens_its_page_and_ends_with_ctrl_c(memmlp: Memmlp, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("webbrowser.open", lambda url: urlopen(url).close() or raise_signal(SIGINT))
    monkeypatch.setattr("memmlp.cli.ui.threading", None)  # where it would wait without a page
    assert memmlp("ui", "--port", "0").code == 0
