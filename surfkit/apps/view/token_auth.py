"""Who may look: the one who has the token that the address on the terminal ends in."""

from __future__ import annotations

import hmac
from collections.abc import Sequence
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from urllib.parse import parse_qs, urlsplit

COOKIE = "surfkit-view"
"""Begin of the cookie's name; the port follows, as browsers send cookies of a host to all of its ports."""


@dataclass(frozen=True)
class AuthRequest:
    """What the gate looks at in a request, of a page, a file or a websocket alike.

    Attributes:
        target: Path and query, as in the first line of the request.
        cookies: Values of all Cookie headers.
        origins: Values of all Origin headers: which page's script asks, where one does.
        hosts: Values of all Host headers.
    """

    target: str
    cookies: Sequence[str] = ()
    origins: Sequence[str] = ()
    hosts: Sequence[str] = ()


@dataclass(frozen=True)
class TokenAuth:
    """Lets a request through that brings the token, in the query of the address or in the cookie that it is then given.

    Attributes:
        token: Characters of URLs only.
        port: Of the server.
    """

    token: str
    port: int

    @property
    def cookie(self) -> str:
        """The Set-Cookie header that replaces the token in the address: for no script and no other site."""
        return f"{COOKIE}-{self.port}={self.token}; Path=/; HttpOnly; SameSite=Lax"

    def brings_token(self, asked: AuthRequest) -> bool:
        """Whether the token is in the query."""
        return any(self._is_token(value) for value in parse_qs(urlsplit(asked.target).query).get("token", ()))

    def admits(self, asked: AuthRequest) -> bool:
        """Whether the request may be answered."""
        if any(urlsplit(origin).netloc not in asked.hosts for origin in asked.origins):
            return False  # a page of another server, or of another port of this host
        return self.brings_token(asked) or any(self._has_cookie(text) for text in asked.cookies)

    def _has_cookie(self, text: str) -> bool:
        try:
            found = SimpleCookie(text).get(f"{COOKIE}-{self.port}")
        except CookieError:
            return False
        return found is not None and self._is_token(found.value)

    def _is_token(self, value: str) -> bool:
        return hmac.compare_digest(value.encode(), self.token.encode())
