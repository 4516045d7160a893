"""How much a browser gets to draw: less where its pictures come late, as without a graphics card.

A script on the page (pace.js) tells how long pictures have taken, and how many things each draw call of them had. A
browser that has not been seen to draw slowly has no limits.
"""

from __future__ import annotations

import http
import math
import statistics
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from surfkit.apps.view.browser_camera import REST_S
from surfkit.apps.view.http_answers import Script, client_in

if TYPE_CHECKING:
    import viser

PATH = "/surfkit/pace"
LATE_S, AIM_S, EARLY_S = 1 / 10, 1 / 15, 1 / 20
"""Time of a picture: above which less is drawn, that which is aimed at then, and below which more is drawn again."""
REST_FACTOR = 3
"""As many times more are drawn while the camera rests."""
JUDGED_PICTURES, LONG_WINDOW_S = 5, 1.0
"""Pictures that are judged together; three of them if they took so long."""
GROWTH_FACTORS = 1.5, 8.0
"""Times that a limit grows at once, at least and at most."""
SLOW_REST_S, REST_PICTURES = 1.0, 6
"""A slow browser's camera that has not moved for so long, and for the time of so many pictures, is at rest: it tells
where it is once a picture."""
RAISE_HOLD_S = 10.0
"""After it was lowered, a limit is not raised for so long."""
INITIAL_LIMITS = {"splats": 5_000, "splats as points": 40_000, "points": 40_000, "triangles": 20_000}
"""Limits of browsers without a graphics card to begin with, by kind."""
MIN_LIMITS = {"splats": 5_000, "splats as points": 10_000, "points": 10_000, "triangles": 10_000}
"""No limits are lower."""
MAX_UNASKED_ITEMS = 20_000
"""Things that any browser may be sent before it has said whether it has a graphics card."""
HELLO_S = 2.0
"""For a browser to say whether it has a graphics card, before it is sent much."""
MAX_REQUEST_TIMES = 100
"""In a request."""


class DrawLimit:
    """Of things of one kind that are drawn, such that pictures come in time while the camera moves.

    Attributes:
        most: While the camera moves; None for no limit.
    """

    def __init__(self, most: int | None = None, least: int = 0) -> None:
        """No pictures are known yet; the limit never becomes less than `least`."""
        self.least, self.most, self.drawn, self.lowered = least, most, 0, -math.inf
        self.times: list[float] = []

    def allowed(self, wanted: int, moves: bool) -> int:
        """How many of those that a user wants are drawn."""
        return wanted if self.most is None else min(wanted, self.most if moves else REST_FACTOR * self.most)

    def judge(self, times: Sequence[float], drawn: int, wanted: int, now: float) -> None:
        """Set the limit by pictures that were drawn.

        A picture takes some time for each thing in it, beside a part that stays and is not known. So after the limit
        was lowered it takes AIM_S or longer; and while it takes less than EARLY_S, half as many more are in time.

        Args:
            times: Of pictures, one after the other, seconds.
            drawn: Things of this kind in each of them.
            wanted: By the user.
            now: Seconds of a clock.
        """
        if drawn != self.drawn:
            self.times, self.drawn = [], drawn
        self.times += times
        if len(self.times) < (JUDGED_PICTURES if sum(self.times) < LONG_WINDOW_S else 3):
            return
        moving = min(drawn, self.allowed(wanted, moves=True))
        took = statistics.median(self.times) * moving / drawn
        self.times = []
        if took > LATE_S:
            self.most, self.lowered = max(int(moving * AIM_S / took), self.least), now
        elif (
            took < EARLY_S
            and self.most is not None
            and drawn <= self.most < wanted
            and now - self.lowered > RAISE_HOLD_S
        ):
            low, high = GROWTH_FACTORS
            self.most = int(self.most * min(max(AIM_S / max(took, 1e-9), low), high))


class DrawPace:
    """Limits of one browser, by kind, and the switch for them.

    Attributes:
        follow: Called when a limit has changed, in another thread, one at a time.
        took: Seconds of a picture, as was told last.
        software: Whether the browser draws without a graphics card, as soon as it has said so.
        said: Set then.
    """

    def __init__(self, client: viser.ClientHandle) -> None:
        """Let the script know its client."""
        self.client = client
        self.follow: Callable[[], None] = lambda: None
        self.limits: dict[str, DrawLimit] = {}
        self.shown: dict[str, tuple[int, int, int]] = {}
        self.took = 0.0
        self.software, self.said, self.answering = False, threading.Event(), threading.Lock()
        self.on: viser.GuiCheckboxHandle | None = None
        client.gui.add_html(f'<span id="surfkit-pace" data-client="{client.client_id}" hidden></span>')

    def add_switch(self) -> None:
        """Into the folder of the panel that is open; it is there as soon as something is limited."""
        hint = "Draws less while the camera moves, and three times as much while it rests."
        self.on = self.client.gui.add_checkbox("keep pace", True, hint=hint, visible=self.software)
        self.on.on_update(lambda _: self.follow())

    def allowed(self, kind: str, wanted: int, moves: bool) -> int:
        """How many things of a kind are drawn."""
        return wanted if self.on is not None and not self.on.value else self._limit(kind).allowed(wanted, moves)

    def rest(self) -> float:
        """Seconds after which a camera that has not moved is at rest."""
        shown = self.shown.copy().items()
        slow = any(self.allowed(kind, wanted, moves=True) < wanted for kind, (_, wanted, _) in shown)
        return max(SLOW_REST_S, REST_PICTURES * self.took) if slow else REST_S

    def sent(self, kind: str, count: int, wanted: int, each: int = 1) -> None:
        """What the browser has of a kind, and would have without limits; draw calls count `each` times as many."""
        self.shown[kind] = count, wanted, each

    def words(self, kind: str, wanted: int, moves: bool) -> str:
        """Why it has fewer, for the line that says how many."""
        if self.allowed(kind, wanted, moves) >= wanted:
            return ""
        return ". This browser draws slowly, so that it gets fewer than the slider allows"

    def _limit(self, kind: str) -> DrawLimit:
        return self.limits.setdefault(
            kind, DrawLimit(INITIAL_LIMITS[kind] if self.software else None, MIN_LIMITS[kind])
        )

    def _all(self) -> dict[str, int | None]:
        return {kind: limit.most for kind, limit in self.limits.copy().items()}

    def answer(self, software: bool, times: Sequence[float], drawn: Sequence[int]) -> tuple[http.HTTPStatus, str]:
        """To what the script tells: times of pictures, seconds, and what each of their draw calls had."""
        if not self.said.is_set():
            self.software = software
            self.said.set()
        if not self.answering.acquire(blocking=False):
            return http.HTTPStatus.TOO_MANY_REQUESTS, "one at a time"
        try:
            self.took = statistics.median(times) if times else self.took
            before = self._all()
            for kind, (count, wanted, each) in self.shown.copy().items():
                if count and count * each in drawn:  # else these are pictures of what it had before
                    self._limit(kind).judge(times, count, wanted, time.monotonic())
            if self._all() != before:
                if self.on is not None:
                    self.on.visible = True
                self.follow()
        finally:
            self.answering.release()
        return http.HTTPStatus.OK, ""


def serve_paces(script: Script, find: Callable[[int], DrawPace | None]) -> None:
    """Add to the script of the pages what tells how fast they are, and answer it.

    Args:
        script: Of the server.
        find: The pace of a client that is there.
    """

    def answer(asked: Mapping[str, str]) -> tuple[http.HTTPStatus, str]:
        client = client_in(asked)
        pace = None if client is None else find(client)
        if pace is None:
            return http.HTTPStatus.NOT_FOUND, "no such client"
        times, drawn = numbers(asked.get("ms", "")), numbers(asked.get("drawn", ""))
        if asked.get("software") not in ("0", "1") or times is None or drawn is None:
            return http.HTTPStatus.BAD_REQUEST, "software: 0 or 1; ms, drawn: up to 100 numbers, 0 or more, and commas"
        return pace.answer(asked["software"] == "1", [each / 1000 for each in times], [int(each) for each in drawn])

    script.add(PATH, Path(__file__).with_name("pace.js").read_text(encoding="utf-8"), answer)


def numbers(text: str) -> list[float] | None:
    """That a text with commas lists, if it does."""
    parts = text.split(",", MAX_REQUEST_TIMES) if text else []
    try:
        found = [float(part) for part in parts]
    except ValueError:
        return None
    return found if len(found) <= MAX_REQUEST_TIMES and all(0 <= each < math.inf for each in found) else None
