"""The page of `surfkit train --view`: pictures of the model, losses and PSNR while a run goes on, and a pause button.

    with live_view(Address(), 0.3) as live:
        with live.following(out):
            run(recipe, data, out)

Two threads serve the page and do nothing while no browser is connected. One orders pictures, which the training draws
between two steps (`surfkit.apps.view.control`); the other reads the journals of the run folder, whoever writes them.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from surfkit.apps.view.browser_camera import WORLD
from surfkit.apps.view.control import TrainingControl
from surfkit.apps.view.cursor import Cursor, serve_cursors
from surfkit.apps.view.live_page import NO_COORDINATES_NOTE, LivePage, SceneWithoutModel
from surfkit.apps.view.live_panel import LivePanel
from surfkit.apps.view.server import Address, RunningServer, served
from surfkit.core.check import BadInput
from surfkit.core.events import say
from surfkit.train.watch import Watched, watched_by

if TYPE_CHECKING:
    import viser

LIVE_COMMAND = "surfkit train --view"
JOURNAL_POLL_S = 1.0
"""Between two looks at the journals, while somebody looks at the page."""
PICTURE_POLL_S = 0.1
"""Between two looks whether a picture is due, while somebody looks at the page."""
THREAD_CLOSE_S = 2.0
"""For a thread to end."""


class Live:
    """The page of a run that goes on.

    Attributes:
        url: Of the page, with its token.
        control: Draws, and holds the training.
    """

    def __init__(self, page: RunningServer, share: float) -> None:
        """Serve; at most a `share` of the time of the training goes into pictures."""
        self.page, self.share, self.url = page, share, page.url
        self.control = TrainingControl()
        self.out: Path | None = None
        self.around: SceneWithoutModel | None = None
        self.pages: dict[int, LivePage] = {}
        self.wake = threading.Event()
        self.failed: set[str] = set()
        self.panel = LivePanel(page.viser.gui, self.control)
        serve_cursors(page.script, self._cursor_of, NO_COORDINATES_NOTE)
        page.viser.on_client_connect(self._connected)
        page.viser.on_client_disconnect(self._disconnected)
        actions = {"pictures": self._draw_pictures, "panel": self._tell}
        self.threads = [threading.Thread(target=action, name=f"live {n}", daemon=True) for n, action in actions.items()]
        for thread in self.threads:
            thread.start()

    @contextmanager
    def following(self, out: Path) -> Iterator[None]:
        """Within, the page shows the run in a folder, and the stages that run in this thread."""
        self.out = out
        with watched_by(self.control):
            yield

    def close(self) -> None:
        """End the threads; the server is about to end."""
        self.page.closing.set()
        self.wake.set()
        for thread in self.threads:
            thread.join(THREAD_CLOSE_S)

    def _cursor_of(self, client_id: int) -> Cursor | None:
        return page.cursor if (page := self.pages.get(client_id)) is not None else None

    def _connected(self, client: viser.ClientHandle) -> None:
        page = LivePage(self.control, client, self.wake, script=not self.page.script.missing)
        if self.around is not None:
            page.enter(self.around)
        self.pages[client.client_id] = page
        self.wake.set()

    def _disconnected(self, client: viser.ClientHandle) -> None:
        self.pages.pop(client.client_id, None)

    def _draw_pictures(self) -> None:
        """Order one picture after the other, and rest after each so that the share is kept."""
        free = 0.0
        while not self.page.closing.is_set():
            now, stage, pages = time.monotonic(), self.control.stage, list(self.pages.values())
            if pages and stage is not None:
                self._carefully("cameras", partial(self._enter, stage), partial(self.panel.tell_failed, "cameras"))
            due = [page for page in pages if page.wants(now)] if stage is not None else []
            if due and (now >= free or self.control.paused):
                page, spent = min(due, key=lambda page: page.drawn), self.control.spent
                self._carefully("pictures", page.draw, page.tell_failed)
                took = self.control.spent - spent + time.perf_counter() - page.received  # not the wait for the step
                free = time.monotonic() + rest(took, self.share)
                continue
            self.wake.wait(PICTURE_POLL_S if pages else None)
            self.wake.clear()

    def _enter(self, stage: Watched) -> None:
        """Show the scene of a stage, if it is another than before."""
        if self.around is None or self.around.scene is not stage.scene:
            around = SceneWithoutModel(stage.scene)
            up, at, middle = around.first
            server = self.page.viser
            server.scene.set_up_direction(up)
            server.initial_camera.up = up
            server.initial_camera.position, server.initial_camera.look_at = at * WORLD, middle * WORLD
            self.around = around
        for page in list(self.pages.values()):
            if page.around is not self.around:
                page.enter(self.around)

    def _tell(self) -> None:
        while not self.page.closing.wait(JOURNAL_POLL_S):
            if self.pages:
                self._carefully("panel", partial(self.panel.show, self.out), partial(self.panel.tell_failed, "panel"))

    def _carefully(self, what: str, action: Callable[[], None], tell: Callable[[str], None]) -> None:
        """Do it, and tell the page what has failed, or nothing; the terminal is told once, and the training goes on."""
        said = ""
        try:
            action()
        except BadInput as error:
            said = str(error)
        except Exception as error:
            said = " ".join(f"{type(error).__name__}: {error}".split())
            if what not in self.failed:
                self.failed.add(what)
                say(f"surfkit: {LIVE_COMMAND}: {what}: {said}; the training goes on")
        tell(said)


def rest(seconds: float, share: float) -> float:
    """How long to do nothing after so many seconds of work, so that the work takes a share of the time."""
    return seconds * (1 - share) / share


@contextmanager
def live_view(address: Address, share: float) -> Iterator[Live]:
    """Within, a page is served that follows a run.

    Args:
        address: Where.
        share: Of the time of the training that pictures may take, above 0 and at most 1.

    Raises:
        BadInput: viser is not installed, the port is taken, or the host is none of this machine.
    """
    with served(address, "surfkit train", LIVE_COMMAND) as page:
        live = Live(page, share)
        try:
            yield live
        finally:
            live.close()
