"""Splats in one browser: how many, in which colours, and as points where that is less work."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from surfkit.apps.view.browser_camera import WORLD, CameraPose, Debouncer, telling
from surfkit.apps.view.browser_geometry import Colors
from surfkit.apps.view.draw_limits import DrawPace
from surfkit.apps.view.lod_selection import ChosenSplats, in_places
from surfkit.apps.view.shared_cache import SPLAT_FORMS, Form, SharedCache

if TYPE_CHECKING:
    import viser

MAX_MOVING_POINTS = 100_000
"""Points while the camera moves."""
FINER_NOTE = "Splats are chosen for where you are, again when you rest. Otherwise they are chosen once, for all places."
SLIDER_STEP = 10_000
"""Of the sliders."""
SPLAT_DOT_SIZE = 200.0
"""Size of splats that are drawn as points, thousandths of `Drawn.unit`: two standard deviations."""


@dataclass(frozen=True)
class SplatRequest:
    """Splats for a browser: drawn as what, how many its user allows, and how many of these it can draw in time."""

    kind: str
    most: int
    budget: int


class SplatLayer:
    """Draws the splats, again when a switch is moved, and of a large model again where the camera comes to rest.

    Attributes:
        moves: Whether the camera does.
    """

    def __init__(self, shelf: SharedCache, client: viser.ClientHandle, pace: DrawPace, count: int) -> None:
        """Build the switches in the folder of the panel that is open, and draw."""
        self.shelf, self.client, self.pace, self.count = shelf, client, pace, count
        self.drawing, self.moves = threading.Lock(), True
        self.node: viser.SceneNodeHandle | None = None
        self.asked: SplatRequest | None = None
        self.has = 0
        self.place, self.places = CameraPose(client), np.zeros(0, np.int64)
        gui = client.gui
        self.shown = gui.add_checkbox("splats", True)
        form: Form = shelf.form or ("points" if pace.software else "splats")
        self.form = gui.add_dropdown("draw as", SPLAT_FORMS, initial_value=form, hint="Points are less work.")
        self.colors = gui.add_dropdown("colours", shelf.colors)
        self.budget = add_budget(gui, "most splats", count, shelf.most)
        self.near_me = gui.add_checkbox("finer where I am", True, hint=FINER_NOTE)
        self.note = gui.add_markdown("")
        self.draw()
        for switch in (self.shown, self.form, self.colors, self.near_me):
            switch.on_update(telling(client, lambda _: self.draw()))
        self.budget.on_update(telling(client, Debouncer(self.draw)))

    def wanted(self) -> SplatRequest:
        """What the switches and the pace of the browser ask for now."""
        as_points = self.form.value == "points" or (self.form.value == "points-while-moving" and self.moves)
        most = min(self.budget.value, self.count)
        if self.moves and self.form.value == "points-while-moving":
            most = min(most, MAX_MOVING_POINTS)
        kind = "splats as points" if as_points else "splats"
        return SplatRequest(kind, most, self.pace.allowed(kind, most, self.moves))

    def by_view(self, asked: SplatRequest) -> bool:
        """Whether the splats are chosen for the camera: there are more than the browser is to have."""
        return self.near_me.value and self.count > asked.budget

    def draw(self) -> None:
        """Send what the switches say."""
        with self.drawing:
            for part in (self.form, self.colors, self.budget, self.near_me, self.note):
                part.visible = self.shown.value
            asked = self.asked = self.wanted()
            self.near_me.visible = self.shown.value and self.count > asked.budget
            if self.shown.value:
                self._send(asked)
            elif self.node is not None:
                self.node.remove()
                self.node = None

    def _send(self, asked: SplatRequest) -> None:
        colors: Colors = self.colors.value
        budget, as_points = asked.budget, asked.kind == "splats as points"
        if self.by_view(asked):
            stand = self.place.begin()
            chosen, told = self.shelf.for_eye(budget, stand.eye)
            if not self.place.serves(stand, fewer=budget < self.has):
                return
            found = self.shelf.drawn(chosen.table, colors)
            if not as_points:
                found = found.placed(self._places_of(chosen, budget), budget)
        else:
            found, told = self.shelf.splats(budget, colors)
        if as_points:
            self.node = add_points(self.client, "/splats", found.means, found.rgb, SPLAT_DOT_SIZE * found.unit)
        else:
            self.node = self.client.scene.add_gaussian_splats(
                "/splats",
                found.means / found.unit,
                found.covariances,
                found.rgb,
                found.opacities[:, None],
                scale=WORLD * found.unit,
            )
        self.has = len(found.means)
        self.pace.sent(asked.kind, len(found.means), asked.most)
        told += self.pace.words(asked.kind, asked.most, self.moves)
        legend = {"height": f"; {self.shelf.height_words()}", "normal": "; red east, green north, blue up"}
        self.note.content = told + legend.get(colors, "")

    def _places_of(self, chosen: ChosenSplats, budget: int) -> np.ndarray:
        """Places in the list of the browser, in which those stay that it has."""
        before = self.places if len(self.places) == budget else np.full(budget, -1)
        found = in_places(before, chosen.ids)
        self.places = np.full(budget, -1)
        self.places[found] = chosen.ids
        return found

    def follow(self) -> None:
        """Draw what is wanted while the camera moves, and where it has come to."""
        asked = self.wanted()
        if self.shown.value and (asked != self.asked or (self.by_view(asked) and self.place.is_due(self.moves))):
            self.draw()


def add_points(client: viser.ClientHandle, name: str, xyz: np.ndarray, rgb: np.ndarray, size: float) -> Any:
    """Draw (N, 3) local points, of a size in thousandths of a local unit."""
    return client.scene.add_point_cloud(
        name, xyz * WORLD, rgb, point_size=size * WORLD / 1000, precision="float32", point_shading="flat"
    )


def add_budget(gui: viser.GuiApi, label: str, count: int, most: int) -> viser.GuiSliderHandle[int]:
    """A slider for how many of `count` are shown, `most` of them at first; it ends where all are."""
    end = max(-(-count // SLIDER_STEP) * SLIDER_STEP, 1)
    return gui.add_slider(label, min(SLIDER_STEP, count, most), end, SLIDER_STEP, min(most, end))
