"""`memmlp ui` refuses what it can't serve, in one line."""

import pytest
from conftest import Memmlp, one_line


@pytest.mark.parametrize(("words", "told"), [
    (["--token", "a token of many letters"], "--token: "),
    (["--host", "0.0.0.0", "--token", "short"], "--token: must have at least 16"),
    (["--host", "nowhere.invalid"], "--host nowhere.invalid --port 8787"),
])  # fmt: skip
def test_what_is_refused(memmlp: Memmlp, words: list[str], told: str):
    assert one_line(memmlp("ui", "--no-browser", *words), told)
