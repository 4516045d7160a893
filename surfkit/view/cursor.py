"""Coordinates under a pointer that moves: viser tells of clicks only, so a script on its page asks for them.

The script (cursor.js) finds in the page which client it is, and sends where the pointer is. The server casts the ray of
that pixel as it does for a click. When the camera moves under a pointer at rest, the server tells the script to ask
again.
"""

from __future__ import annotations

import http
import math
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from surfkit.view.answers import Script
from surfkit.view.measure import coordinates
from surfkit.view.screen import ray_through
from surfkit.view.shelf import Shelf

if TYPE_CHECKING:
    import viser

WITHOUT = "coordinates are shown after a click, not under a pointer that moves"
WIDEST = 100.0
"""Of a window, widths by heights."""

Pick = Callable[[np.ndarray, np.ndarray], np.ndarray | None]
"""Local place that a ray meets, of local origin and unit direction."""


class Cursor:
    """What one browser asks for while its pointer moves, and the switch for it."""

    def __init__(self, shelf: Shelf, client: viser.ClientHandle, folder: Any, pick: Pick) -> None:
        """Put the switch into a folder of the panel; `pick` is that of clicks."""
        self.subject, self.client, self.pick = shelf.subject, client, pick
        self.answering, self.shown, self.turn = threading.Lock(), False, 0
        with folder:
            self.on = client.gui.add_checkbox("follow the pointer", True, hint="Shows the coordinates under it.")
        self.tag = client.gui.add_html(self._tag())
        self.on.on_update(lambda _: self._tell())
        client.camera.on_update(lambda _: self._turned())

    def answer(self, x: float, y: float) -> tuple[http.HTTPStatus, str]:
        """Coordinates of what lies under the pointer; no text where there is nothing. One at a time.

        Args:
            x: From the middle of the window to the right, in halves of its height.
            y: Downwards.
        """
        if not self.on.value:
            return http.HTTPStatus.CONFLICT, "switched off"
        if not self.answering.acquire(blocking=False):
            return http.HTTPStatus.TOO_MANY_REQUESTS, "one at a time"
        try:
            self.shown = True  # before the camera is looked at: what moves it from now on is told
            place = self.pick(*ray_through(self.client.camera, x, y))
        finally:
            self.answering.release()
        return http.HTTPStatus.OK, "" if place is None else coordinates(place, self.subject.frame, self.subject.up)

    def _tag(self) -> str:
        """What the script reads; empty names tell it to be silent."""
        client = self.client.client_id if self.on.value else ""
        return f'<span id="surfkit-cursor" data-client="{client}" data-turn="{self.turn}" hidden></span>'

    def _tell(self) -> None:
        self.turn += 1
        self.tag.content = self._tag()

    def _turned(self) -> None:
        if self.shown:
            self.shown = False
            self._tell()


def serve_cursors(script: Script, find: Callable[[int], Cursor | None]) -> None:
    """Give pages the script, and answer it; `find` gives the cursor of a client that is there."""

    def answer(asked: Mapping[str, str]) -> tuple[http.HTTPStatus, str]:
        client = asked.get("client", "")
        cursor = find(int(client)) if client.isascii() and client.isdecimal() and len(client) < 20 else None
        if cursor is None:
            return http.HTTPStatus.NOT_FOUND, "no such client"
        x, y = (number(asked.get(name, ""), most) for name, most in (("x", WIDEST), ("y", 1.0)))
        if x is None or y is None:
            return http.HTTPStatus.BAD_REQUEST, "x, y: numbers, within the window"
        return cursor.answer(x, y)

    script.set(Path(__file__).with_name("cursor.js").read_text(encoding="utf-8"), answer, WITHOUT)


def number(text: str, most: float) -> float | None:
    """What a text says, if that is a number from -most to most."""
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) and abs(value) <= most else None
