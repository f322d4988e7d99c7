"""Who may send requests to a page's server: this machine's own browser, or whoever has the token.

At this machine's own address, a request must name that address, since another name that leads here is DNS
rebinding, and must not come from another site's page. At any other address, each request needs the token:
first in the printed address, and from then on in a cookie, so that the token is in no browser history.
"""

from __future__ import annotations

import secrets
import urllib.parse
from collections.abc import Mapping
from email.message import Message
from http.cookies import CookieError, SimpleCookie
from ipaddress import ip_address

from memmlp.common.errors import InputError

LOCAL = ("127.0.0.1", "localhost")
COOKIE = "memmlp_token"
SHORTEST = 16  # characters of a token


class Access:
    """The rules of a server.

    Args:
        host: the address at which the server listens.
        token: what requests need at any address but this machine's own; None for a new random token.

    Attributes:
        token: the token; None at this machine's own address, which needs none.
    """

    def __init__(self, host: str, token: str | None = None):
        self.host = host
        self.token = None if loopback(host) else token or secrets.token_urlsafe(24)

    def allows(self, path: str, headers: Message, port: int) -> bool:
        """Return whether a request may be answered, given its host, its origin and its token."""
        url = urllib.parse.urlsplit(path)
        if headers.get("Sec-Fetch-Site", "none") not in ("none", "same-origin"):
            return headers.get("Sec-Fetch-Mode") == "navigate" and url.path == "/"
        if self.token is None:
            return _name(headers.get("Host", "")) in (*LOCAL, self.host)
        given = self.given(url.query) or _cookie(headers, port)
        return secrets.compare_digest(given.encode(), self.token.encode())

    def allows_change(self, path: str, headers: Message, port: int) -> bool:
        """Return whether a request may change something: it must not come from another site's page."""
        origin = headers.get("Origin")  # browsers send it with every POST
        own = (None, f"http://{headers.get('Host', '')}")
        return origin in own and self.allows(path, headers, port)

    def given(self, query: str) -> str:
        """Return the token in the query of an address, or nothing."""
        return dict(urllib.parse.parse_qsl(query)).get("token", "")

    def redirect_headers(self, token: str, port: int) -> Mapping[str, str]:
        """Return the headers that redirect to the page with the token in a cookie instead of the address."""
        named = f"{COOKIE}_{port}={urllib.parse.quote(token)}"
        return {"Location": "/", "Set-Cookie": f"{named}; HttpOnly; SameSite=Strict; Path=/"}

    def url(self, name: str, port: int) -> str:
        """Return the page's address, with the token if one is needed."""
        ending = f"?token={urllib.parse.quote(self.token)}" if self.token else ""
        return f"http://{name}:{port}/{ending}"


def loopback(host: str) -> bool:
    """Return whether an address is 127.0.0.1 or localhost, at which no other machine can reach this one."""
    try:
        return host == "localhost" or (ip_address(host).is_loopback and ip_address(host).version == 4)
    except ValueError:
        return False


def check_token(host: str, token: str | None) -> None:
    """Raise InputError for a token that is too short, or not needed at an address."""
    if token is not None and loopback(host):
        raise InputError("--token: goes with --host; this machine's own address needs none")
    if token is not None and len(token) < SHORTEST:
        raise InputError(f"--token: {len(token)} characters; allowed are {SHORTEST} or more")


def _name(host: str) -> str:
    """Return the name in a Host header, without the port."""
    return host.rpartition(":")[0] or host


def _cookie(headers: Message, port: int) -> str:
    try:
        found = SimpleCookie(headers.get("Cookie", "")).get(f"{COOKIE}_{port}")
    except CookieError:
        return ""
    return urllib.parse.unquote(found.value) if found else ""
