"""The page of a subject: one for each browser that has come through the gate."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from surfkit.apps.render.path import beside
from surfkit.apps.view.browser_camera import WORLD, ray_of, ray_through, telling
from surfkit.apps.view.cursor import Cursor, serve_cursors
from surfkit.apps.view.draw_limits import HELLO_S, MAX_UNASKED_ITEMS, DrawPace, serve_paces
from surfkit.apps.view.layers import Layers
from surfkit.apps.view.measure_clicks import coordinates
from surfkit.apps.view.photo_comparison import PhotoComparisonTool
from surfkit.apps.view.server import RunningServer
from surfkit.apps.view.shared_cache import DEFAULT_BUDGET, Form, SharedCache
from surfkit.apps.view.tools import CropTool, MeasureTool, PathTool
from surfkit.apps.view.viewer_scene import ViewerScene
from surfkit.core.memory import give_back

if TYPE_CHECKING:
    import viser

CLICK_COORDINATES_NOTE = "coordinates are shown after a click, not under a pointer that moves"
PAGE_HELP = """
**Mouse.** Left: turn. Right, or with shift: move. Wheel: nearer, farther. Double click: turn about that place.

**Keys.** W A S D: fly; Q E: down, up; arrows: turn. They work after a click into the picture.

**Pointer.** The coordinates under it stand at the lower left; a switch under *Measure* turns that off.

**Click.** On a camera: its photograph. On the surface: its coordinates; a point of the line, while *measure* is on.
"""


def show(
    subject: ViewerScene, served: RunningServer, folder: Path, most: int = DEFAULT_BUDGET, form: Form | None = None
) -> None:
    """Show a subject to every browser that comes.

    Args:
        subject: What to look at.
        served: A server with an empty scene.
        folder: For the files that a user writes.
        most: Splats, triangles and points that are sent to a browser to begin with.
        form: How splats are drawn to begin with; None leaves it to whether a browser has a graphics card.
    """
    shelf = SharedCache(subject, most, form)
    server = served.viser
    up, at, middle = first_view(subject)
    server.scene.set_up_direction(up)
    server.initial_camera.up = up
    server.initial_camera.position = at * WORLD
    server.initial_camera.look_at = middle * WORLD
    threading.Thread(target=shelf.prepare, daemon=True).start()
    pages: dict[int, ViewerPage] = {}
    paces: dict[int, DrawPace] = {}

    def cursor_of(client_id: int) -> Cursor | None:
        return page.cursor if (page := pages.get(client_id)) is not None else None

    serve_cursors(served.script, cursor_of, CLICK_COORDINATES_NOTE)
    serve_paces(served.script, paces.get)

    @server.on_client_connect
    def _(client: viser.ClientHandle) -> None:
        def build(_event: None) -> None:
            pace = paces[client.client_id] = DrawPace(client)
            if shelf.size > MAX_UNASKED_ITEMS and not served.script.missing:
                pace.said.wait(HELLO_S)
            pages[client.client_id] = ViewerPage(shelf, client, pace, folder, served)
            if client.client_id not in server.get_clients():  # it left meanwhile
                leave(client)

        telling(client, build)(None)

    @server.on_client_disconnect
    def leave(client: viser.ClientHandle) -> None:
        paces.pop(client.client_id, None)
        if (page := pages.pop(client.client_id, None)) is not None:
            page.path.stop()
            page.layers.stop()
        if not pages:
            shelf.forget_choices()
        give_back()


class ViewerPage:
    """What one browser shows; another has its own layers, measures, box and path."""

    def __init__(
        self, shelf: SharedCache, client: viser.ClientHandle, pace: DrawPace, folder: Path, served: RunningServer
    ) -> None:
        """Build the page."""
        self.shelf, self.client, self.fov = shelf, client, client.camera.fov
        client.gui.add_button("show all").on_click(lambda _: self._show_all())
        self.layers = Layers(shelf, client, pace)
        self.measure = MeasureTool(shelf, client)
        self.cursor = None if served.script.missing else self._follow_pointer()
        self.photographs = PhotoComparisonTool(shelf, client, self.layers) if shelf.subject.views else None
        CropTool(shelf, client, folder)
        self.path = PathTool(shelf, client, folder, served.closing)
        with client.gui.add_folder("Help", expand_by_default=False):
            client.gui.add_markdown(PAGE_HELP)
        client.scene.on_click()(telling(client, self._click))

    def _follow_pointer(self) -> Cursor:
        """Coordinates of what the pointer is on, as a click shows them."""
        client, subject = self.client, self.shelf.subject

        def say(x: float, y: float) -> str:
            place = self._pick(*ray_through(client.camera, x, y))
            return "" if place is None else coordinates(place, subject.frame, subject.up)

        cursor = Cursor(client, self.measure.folder, say)
        client.camera.on_update(lambda _: cursor.changed())
        return cursor

    def _show_all(self) -> None:
        """Back to the first view."""
        up, at, middle = first_view(self.shelf.subject)
        camera = self.client.camera
        camera.position, camera.look_at = at * WORLD, middle * WORLD
        camera.up_direction, camera.fov = up, self.fov

    def _click(self, event: viser.SceneClickEvent) -> None:
        origin, direction = ray_of(event)
        if self.photographs is not None and not self.measure.on.value:
            camera = self.photographs.hit(origin, direction)
            if camera is not None:
                self.photographs.choose(camera, stand=self.photographs.follow.value)
                return
        self.measure.click(self._pick(origin, direction))

    def _pick(self, origin: np.ndarray, direction: np.ndarray) -> np.ndarray | None:
        """The local place on the surface that a ray meets."""
        return self.shelf.pick(origin, direction, mesh=self.layers.shows_mesh)


def first_view(subject: ViewerScene) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Up, where the camera stands and what it looks at, local frame: from the side, half from above."""
    positions = subject.positions()
    rows = positions[:: max(1, len(positions) // 100_000)].astype(np.float64)
    middle = np.median(rows, axis=0)
    reach = float(np.quantile(np.linalg.norm(rows - middle, axis=1), 0.8)) or 1.0
    east, north = beside(subject.up)
    return subject.up, middle + 1.6 * reach * (0.3 * east - north + 0.8 * subject.up), middle
