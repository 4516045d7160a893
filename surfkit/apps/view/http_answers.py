"""HTTP answers beside viser's: short ones, and a script on its page for what viser has no event for."""

from __future__ import annotations

import asyncio
import gzip
import http
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any
from urllib.parse import parse_qsl

from surfkit.core.events import say

SCRIPT = "/surfkit/script.js"
ASK = "/surfkit/ask"
"""What the script asks first of all."""
BODY_END = b"</body>"
"""The script is put before it."""

Answer = Callable[[Mapping[str, str]], tuple[http.HTTPStatus, str]]
"""Status and text for the query of a request; called in threads, several at a time."""


class Script:
    """A script that the page is given, and the answers to what it asks; none until it is set.

    Attributes:
        text: JavaScript.
        answers: To what it asks, by path.
        missing: Whether there was a page with no place for it.
        without: What the user is told then.
    """

    def __init__(self) -> None:
        """None yet."""
        self.text, self.without, self.missing = "", "", False
        self.answers: dict[str, Answer] = {}

    def set(self, text: str, answer: Answer, without: str) -> None:
        """Give it to all pages from now on."""
        self.text, self.answers, self.without = text, {ASK: answer}, without

    def add(self, path: str, text: str, answer: Answer) -> None:
        """Have it do something else besides, for which it asks at another path."""
        self.text, self.answers = self.text + text, {**self.answers, path: answer}

    async def respond(self, target: str) -> Any:
        """The response to a request, or None if it is no matter of the script.

        Args:
            target: Path and query of the request, which the gate has let through.
        """
        path, _, query = target.partition("?")
        if path == SCRIPT and self.answers:
            return response(http.HTTPStatus.OK, self.text, {"Content-Type": "text/javascript; charset=utf-8"})
        if path not in self.answers:
            return None
        return response(*await asyncio.to_thread(self.answers[path], dict(parse_qsl(query))))

    def into(self, found: Any) -> Any:
        """A response of viser, with the script in it if it is a page."""
        if not self.answers or found is None or not is_page(found):
            return found
        body = with_script(found.body, found.headers.get("Content-Encoding", "identity"))
        if body is None:
            if not self.missing:
                self.missing = True
                say(f"surfkit: this version of viser has a page of another form; {self.without}")
            return found
        from websockets.http11 import Response

        headers = found.headers.copy()
        for name in ("Content-Length", "ETag", "Last-Modified"):  # of the page without the script
            headers.pop(name, None)
        headers["Content-Length"] = str(len(body))
        return Response(found.status_code, found.reason_phrase, headers, body)


def client_in(asked: Mapping[str, str]) -> int | None:
    """The number of the client that asks, if it is one."""
    text = asked.get("client", "")
    return int(text) if text.isascii() and text.isdecimal() and len(text) < 20 else None


def is_page(found: Any) -> bool:
    """Whether a response is one of HTML."""
    return found.status_code == http.HTTPStatus.OK and found.headers.get("Content-Type", "").startswith("text/html")


@lru_cache(2)
def with_script(body: bytes, encoding: str) -> bytes | None:
    """The body of a page, packed as before, with a reference to the script; None if there is no place for it."""
    if encoding not in ("identity", "gzip"):
        return None
    plain = gzip.decompress(body) if encoding == "gzip" else body
    before, end, after = plain.rpartition(BODY_END)
    if not end:
        return None
    page = b"".join([before, f'<script src="{SCRIPT[1:]}" defer></script>'.encode(), end, after])
    return gzip.compress(page) if encoding == "gzip" else page


def response(status: http.HTTPStatus, text: str, headers: Mapping[str, str] | None = None) -> Any:
    """A short answer that no browser keeps."""
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    body = text.encode()
    plain = {
        "Content-Type": "text/plain; charset=utf-8",
        "Content-Length": str(len(body)),
        "Cache-Control": "no-store",
        "Referrer-Policy": "no-referrer",
        "X-Content-Type-Options": "nosniff",
    }
    return Response(status, status.phrase, Headers({**plain, **(headers or {})}), body)
