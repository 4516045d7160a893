"""A video of the camera path of one browser, made while the page goes on; as `surfkit render` makes it."""

from __future__ import annotations

import shlex
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import torch

from surfkit.apps.render.frame_files import Show, identity
from surfkit.apps.render.path import from_file
from surfkit.apps.render.video import Film, frames_of, make_video, require_video
from surfkit.apps.view.browser_camera import telling
from surfkit.apps.view.escape_text import as_code, as_text
from surfkit.apps.view.shared_cache import SharedCache
from surfkit.core.check import BadInput
from surfkit.core.events import say
from surfkit.scene.camera import Camera

if TYPE_CHECKING:
    import viser

FILM_SIZES = ("1920x1080", "1280x720", "640x360")
FILM_POLL_S = 0.5
"""Between two looks at how far it is."""


class Stopped(Exception):
    """The user wants no video any more, or the server ends."""


class FilmTool:
    """Draws the frames of a path, one at a time, so that clicks come between; encodes them; can be stopped."""

    def __init__(
        self,
        shelf: SharedCache,
        client: viser.ClientHandle,
        folder: Any,
        save: Callable[[], Path],
        closing: threading.Event,
    ) -> None:
        """Build the panel.

        Args:
            shelf: What is drawn.
            client: The browser.
            folder: Of the panel.
            save: Writes the path that the browser has now, or finds that it is written; its file.
            closing: Set when the server ends.
        """
        self.shelf, self.save, self.closing = shelf, save, closing
        self.stopping, self.running, self.told_at = threading.Event(), False, 0.0
        gui = client.gui
        with folder:
            self.size = gui.add_dropdown("size", FILM_SIZES)
            self.show = gui.add_dropdown("of", get_args(Show))
            self.button = gui.add_button("make the video")
            self.bar: Any = gui.add_progress_bar(0.0, visible=False)  # its value is read-only for mypy, see `set_value`
            self.told = gui.add_markdown("", visible=False)
        self.button.on_click(telling(client, lambda _: self._clicked()))

    def _clicked(self) -> None:
        """Begin, or stop."""
        if self.running:
            self.stopping.set()
            return
        require_video()
        path = self.save()
        show: Show = self.show.value
        self.stopping.clear()
        self.running = True
        self.told.content, self.bar.value = "begins", 0.0
        self.button.label, self.bar.visible, self.told.visible = "stop", True, True
        threading.Thread(target=self._run, args=(path, self.size.value, show), name="video").start()

    def _run(self, path: Path, size: str, show: Show) -> None:
        """Make the video beside the file of its path; whatever fails is said on the page."""
        video, said = path.with_name(f"{path.stem}-{show}-{size}.mp4"), ""
        try:
            self._make(path, video, size, show)
            said = f"{as_code(video)} is written."
            say(f"{video} is written")  # its browser may have gone
        except Stopped:
            kept = f"the pictures so far are kept in {frames_of(video)}"
            command = self._command(path, video, size, show)
            said = f"Stopped; {as_text(kept)}. *make the video* goes on"
            said += f", and so does\n\n{as_code(command)}" if command else "."
            if self.closing.is_set():
                say(f"{video} is not finished; {kept}" + (f"; it goes on with {command}" if command else ""))
        except BadInput as error:
            said = as_text(error)
        except Exception as error:
            said = as_text(" ".join(f"{type(error).__name__}: {error}".split()))
        self.running = False
        if not self.closing.is_set():
            self.button.label, self.bar.visible, self.told.content = "make the video", False, said

    def _command(self, path: Path, video: Path, size: str, show: Show) -> str:
        """That makes the same video, of a run; nothing for a file."""
        source = self.shelf.subject.path
        words = ["surfkit", "render", str(source), "--path", str(path), "--size", size, "--show", show]
        return shlex.join([*words, "--out", str(video)]) if source.is_dir() else ""

    def _make(self, path: Path, video: Path, size: str, show: Show) -> None:
        """Make it; `surfkit render` with the same path, size and file goes on where this was stopped."""
        width, height = map(int, size.split("x"))
        subject = self.shelf.subject
        lens = Camera(torch.eye(4, dtype=torch.float64), height, height, width / 2, height / 2, width, height)
        flight = from_file(path, subject.frame, lens, 1)  # which has its own fields of view, frames and speed
        assert flight.fps is not None
        film = Film(flight.cameras, self.shelf.draw, show, identity(subject.path), flight.fps)
        make_video(video, film, tell=self._tell)

    def _tell(self, what: str, done: int, total: int) -> None:
        """Show how far it is; Stopped if it is to end."""
        if self.stopping.is_set() or self.closing.is_set():
            raise Stopped
        now = time.monotonic()
        if now >= self.told_at + FILM_POLL_S or done == total:
            self.told_at = now
            self.bar.value, self.told.content = 100 * done / total, f"{what}: {done:,} of {total:,}"
