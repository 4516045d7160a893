"""Points in one browser: how many, and how large."""

from __future__ import annotations

import math
import threading
from typing import TYPE_CHECKING

import numpy as np

from surfkit.apps.view.browser_camera import CameraPose, Debouncer, telling
from surfkit.apps.view.browser_geometry import some
from surfkit.apps.view.draw_limits import DrawPace
from surfkit.apps.view.shared_cache import MAX_POINT_ENLARGEMENT, SharedCache
from surfkit.apps.view.splat_layer import add_budget, add_points
from surfkit.apps.view.viewer_scene import ViewerPoints

if TYPE_CHECKING:
    import viser

POINT_KIND = "points"


class PointLayer:
    """Draws points: as many as the slider says, evenly spread over their order; or, in a slow browser, near its camera.

    Attributes:
        moves: Whether the camera does.
    """

    def __init__(self, shelf: SharedCache, client: viser.ClientHandle, pace: DrawPace, points: ViewerPoints) -> None:
        """Build the switches in the folder of the panel that is open, and draw."""
        self.shelf, self.client, self.pace, self.points = shelf, client, pace, points
        self.drawing, self.moves, self.place = threading.Lock(), True, CameraPose(client)
        self.asked, self.rows, self.larger = 0, np.zeros(0, np.int64), 1.0
        alone = shelf.subject.splats is None and shelf.subject.mesh is None
        gui = client.gui
        self.shown = gui.add_checkbox("points" if alone else "sparse points", alone)
        self.size = gui.add_slider("size of points", 0.5, 10, 0.5, 2.0)
        self.budget = add_budget(gui, "most points", len(points.xyz), shelf.most)
        self.note = gui.add_markdown("")
        self.draw()
        self.shown.on_update(telling(client, lambda _: self.draw()))
        for slider in (self.size, self.budget):
            slider.on_update(telling(client, Debouncer(self.draw)))

    @property
    def most(self) -> int:
        """That the user allows."""
        return min(self.budget.value, len(self.points.xyz))

    def wanted(self) -> int:
        """That are to be drawn now."""
        return self.pace.allowed(POINT_KIND, self.most, self.moves)

    def draw(self) -> None:
        """Send what the switches say."""
        with self.drawing:
            for part in (self.size, self.budget, self.note):
                part.visible = self.shown.value
            if self.shown.value:
                self._send()
            else:
                self.client.scene.remove_by_name("/points")

    def _send(self) -> None:
        count, most, asked = len(self.points.xyz), self.most, self.wanted()
        self.asked, larger = asked, 1.0
        if asked < len(self.rows) < most and self.moves:  # at once, and those that are nearer follow
            rows = self.rows[some(len(self.rows), asked)]
            larger = min(self.larger * math.sqrt(len(self.rows) / asked), MAX_POINT_ENLARGEMENT)
        elif asked < most:
            stand = self.place.begin()
            rows, larger = self.shelf.points_for_eye(asked, stand.eye)
            if not self.place.serves(stand, fewer=asked < len(self.rows)):
                return
        else:
            rows = some(count, most)
        add_points(self.client, "/points", self.points.xyz[rows], self.points.rgb[rows], larger * self.size.value)
        self.rows, self.larger = rows, larger
        self.pace.sent(POINT_KIND, len(rows), most)
        self.note.content = (
            f"{len(rows):,} of {count:,} points are shown{self.pace.words(POINT_KIND, most, self.moves)}"
        )

    def follow(self) -> None:
        """Draw as many as the browser can draw in time while the camera moves, or rests, and those near it."""
        asked = self.wanted()
        if self.shown.value and (asked != self.asked or (asked < self.most and self.place.is_due(self.moves))):
            self.draw()
