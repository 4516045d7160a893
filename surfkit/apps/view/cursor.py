"""Coordinates under a pointer that moves: viser tells of clicks only, so a script on its page asks for them.

The script (cursor.js) finds in the page which client it is, and sends where the pointer is; the page says what lies
there. When something else comes to lie under a pointer at rest, the server tells the script to ask again.
"""

from __future__ import annotations

import http
import math
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from surfkit.apps.view.http_answers import Script, client_in

if TYPE_CHECKING:
    import viser

MAX_ASPECT = 100.0
"""Of a window, widths by heights."""

Say = Callable[[float, float], str]
"""What lies under the pointer, in words, or nothing. Its place is x from the middle of the window to the right and y
downwards, in halves of the height of the window."""


class Cursor:
    """What one browser asks for while its pointer moves, and the switch for it."""

    def __init__(self, client: viser.ClientHandle, folder: Any, say: Say) -> None:
        """Put the switch into a folder of the panel; `say` is called in other threads, once at a time."""
        self.client, self.say = client, say
        self.answering, self.telling = threading.Lock(), threading.Lock()
        self.shown, self.turn = False, 0
        with folder:
            self.on = client.gui.add_checkbox("follow the pointer", True, hint="Shows the coordinates under it.")
        self.tag = client.gui.add_html(self._tag())
        self.on.on_update(lambda _: self._switched())

    def answer(self, x: float, y: float) -> tuple[http.HTTPStatus, str]:
        """What `say` says of a place, one at a time."""
        if not self.on.value:
            return http.HTTPStatus.CONFLICT, "switched off"
        if not self.answering.acquire(blocking=False):
            return http.HTTPStatus.TOO_MANY_REQUESTS, "one at a time"
        try:
            self.shown = True  # before it is looked at: what changes from now on is told
            return http.HTTPStatus.OK, self.say(x, y)
        finally:
            self.answering.release()

    def changed(self) -> None:
        """Something else may lie under the pointer; the script is told once, and again after it has asked."""
        with self.telling:  # several threads may know of it
            if self.shown:
                self.shown = False
                self._tell()

    def _switched(self) -> None:
        with self.telling:
            self._tell()

    def _tag(self) -> str:
        """What the script reads; empty names tell it to be silent."""
        client = self.client.client_id if self.on.value else ""
        return f'<span id="surfkit-cursor" data-client="{client}" data-turn="{self.turn}" hidden></span>'

    def _tell(self) -> None:
        self.turn += 1
        self.tag.content = self._tag()


def serve_cursors(script: Script, find: Callable[[int], Cursor | None], without: str) -> None:
    """Give pages the script, and answer it.

    Args:
        script: Of the server.
        find: The cursor of a client that is there.
        without: What the user is told if the page has no place for the script.
    """

    def answer(asked: Mapping[str, str]) -> tuple[http.HTTPStatus, str]:
        client = client_in(asked)
        cursor = None if client is None else find(client)
        if cursor is None:
            return http.HTTPStatus.NOT_FOUND, "no such client"
        x, y = (number(asked.get(name, ""), most) for name, most in (("x", MAX_ASPECT), ("y", 1.0)))
        if x is None or y is None:
            return http.HTTPStatus.BAD_REQUEST, "x, y: numbers, within the window"
        return cursor.answer(x, y)

    script.set(Path(__file__).with_name("cursor.js").read_text(encoding="utf-8"), answer, without)


def number(text: str, most: float) -> float | None:
    """What a text says, if that is a number from -most to most."""
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) and abs(value) <= most else None
