"""Who may send requests to a page's server: a browser on this machine, or whoever has the token.

At the loopback address, a request must name that address (another name would be DNS rebinding), and must not
come from another site's page. At any other address, each request needs the token: first in the printed
address, then in a cookie, so that the browser's history does not contain it.
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
MIN_LENGTH = 16  # characters of a token


class Access:
    """The rules of a server.

    Args:
        host: the address at which the server listens.
        token: what requests need at any address but the loopback address; None for a new random token.

    Attributes:
        token: the token; None at the loopback address, which does not need one.
    """

    def __init__(self, host: str, token: str | None = None):
        self.host = host
        self.token = None if is_loopback(host) else token or secrets.token_urlsafe(24)

    def allows(self, path: str, headers: Message, port: int) -> bool:
        """Return whether a request may be answered, given its host, its origin and its token."""
        url = urllib.parse.urlsplit(path)
        if headers.get("Sec-Fetch-Site", "none") not in ("none", "same-origin"):
            return headers.get("Sec-Fetch-Mode") == "navigate" and url.path == "/"
        if self.token is None:
            host = headers.get("Host", "")
            return (host.rpartition(":")[0] or host) in (*LOCAL, self.host)
        given = self.token_in(url.query) or _cookie(headers, port)
        return secrets.compare_digest(given.encode(), self.token.encode())

    def allows_change(self, path: str, headers: Message, port: int) -> bool:
        """Return whether a request may change something: it must not come from another site's page."""
        origin = headers.get("Origin")  # browsers send it with every POST
        return origin in (None, f"http://{headers.get('Host', '')}") and self.allows(path, headers, port)

    def token_in(self, query: str) -> str:
        """Return the token in the query of an address; empty if it does not have one."""
        return dict(urllib.parse.parse_qsl(query)).get("token", "")

    def redirect_headers(self, token: str, port: int) -> Mapping[str, str]:
        """Return the headers that redirect to the page with the token in a cookie instead of the address."""
        named = f"{COOKIE}_{port}={urllib.parse.quote(token)}"
        return {"Location": "/", "Set-Cookie": f"{named}; HttpOnly; SameSite=Strict; Path=/"}

    def url(self, name: str, port: int) -> str:
        """Return the page's address, with the token if one is needed."""
        ending = f"?token={urllib.parse.quote(self.token)}" if self.token else ""
        return f"http://{name}:{port}/{ending}"


def is_loopback(host: str) -> bool:
    """Return whether an address is 127.0.0.1 or localhost, at which no other machine can reach this one."""
    try:
        return host == "localhost" or (ip_address(host).is_loopback and ip_address(host).version == 4)
    except ValueError:
        return False


def check_token(host: str, token: str | None) -> None:
    """Raise InputError for a token that is too short, or not needed at an address."""
    if token is not None and is_loopback(host):
        raise InputError("--token: is only for --host; the loopback address does not need it")
    if token is not None and len(token) < MIN_LENGTH:
        raise InputError(f"--token: must have at least {MIN_LENGTH} characters")


def _cookie(headers: Message, port: int) -> str:
    try:
        found = SimpleCookie(headers.get("Cookie", "")).get(f"{COOKIE}_{port}")
    except CookieError:
        return ""
    return urllib.parse.unquote(found.value) if found else ""
