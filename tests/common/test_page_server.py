"""Who may ask a page's server, and who may change something."""

from email.message import Message
from urllib.parse import quote

import pytest

from memmlp.common.errors import InputError
from memmlp.common.page_server import COOKIE, AccessRules, check_token, is_loopback

TOKEN = "a token of many letters"


def headers(**given: str) -> Message:
    """Headers of a request; _ stands for -."""
    made = Message()
    for name, value in given.items():
        made[name.replace("_", "-")] = value
    return made


@pytest.mark.parametrize(("host", "alone"), [
    ("127.0.0.1", True), ("localhost", True), ("127.0.0.2", True), ("0.0.0.0", False), ("::", False),
])  # fmt: skip
def test_which_addresses_are_this_machine_s_alone(host: str, alone: bool):
    assert is_loopback(host) is alone
    assert (AccessRules(host).token is None) is alone


@pytest.mark.parametrize(("given", "allowed"), [
    ({"Host": "127.0.0.1:8765"}, True), ({"Host": "localhost"}, True), ({}, False),
    ({"Host": "127.0.0.1.evil.example:80"}, False), ({"Host": "evil.example:8765"}, False),
    ({"Host": "localhost", "Sec_Fetch_Site": "cross-site"}, False),
    ({"Host": "localhost", "Sec_Fetch_Site": "same-origin"}, True),
])  # fmt: skip
def test_this_machine_s_own_address(given: dict[str, str], allowed: bool):
    assert AccessRules("127.0.0.1").allows("/events", headers(**given), 8765) is allowed


@pytest.mark.parametrize(("path", "cookie", "allowed"), [
    ("/", "", False), ("/?token=", "", False), ("/?token=wrong", "", False), ("/?token=%ff", "", False),
    (f"/?token={quote(TOKEN)}", "", True), ("/events", f"{COOKIE}_8765={quote(TOKEN)}", True),
    ("/events", f"{COOKIE}_1={quote(TOKEN)}", False), ("/events", f"{COOKIE}_8765=wrong", False),
])  # fmt: skip
def test_another_address_needs_the_token(path: str, cookie: str, allowed: bool):
    asked = headers(Host="192.168.1.5:8765", **({"Cookie": cookie} if cookie else {}))
    assert AccessRules("192.168.1.5", TOKEN).allows(path, asked, 8765) is allowed


@pytest.mark.parametrize(("origin", "allowed"), [
    (None, True), ("http://localhost:8765", True), ("http://localhost:8766", False), ("null", False),
])  # fmt: skip
def test_only_the_page_itself_changes_something(origin: str | None, allowed: bool):
    """A page of another site can send a form here, with the browser's cookies."""
    given = headers(Host="localhost:8765", **({"Origin": origin} if origin else {}))
    assert AccessRules("127.0.0.1").allows_change("/wearer", given, 8765) is allowed


def test_a_new_token_is_long_and_another_each_time():
    first, second = AccessRules("0.0.0.0").token, AccessRules("0.0.0.0").token
    assert first != second
    assert len(first or "") >= 32


@pytest.mark.parametrize(("host", "token"), [("127.0.0.1", TOKEN), ("0.0.0.0", "short")])
def test_a_token_that_makes_no_sense_is_one_line(host: str, token: str):
    with pytest.raises(InputError, match="--token: "):
        check_token(host, token)
