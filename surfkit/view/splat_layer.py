"""Splats in one browser: how many, in which colours, and as points where that is less work."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Any

import numpy as np

from surfkit.view.by_view import Chosen, in_places
from surfkit.view.display import Colors
from surfkit.view.screen import WORLD, Following, Latest, Stand, telling
from surfkit.view.shelf import FORMS, Shelf

if TYPE_CHECKING:
    import viser

MOVING = 100_000
"""Points while the camera moves."""
BETWEEN_S = 1.0
"""From one choice to the next, at least, while the camera moves."""
FINER = "Splats are chosen for where you are, again when you rest. Otherwise they are chosen once, for all places."
STEP = 10_000
"""Of the sliders."""
DOT = 200.0
"""Size of splats that are drawn as points, thousandths of `Drawn.unit`: two standard deviations."""


class SplatLayer:
    """Draws the splats, again when a switch is moved, and of a large model again where the camera comes to rest."""

    def __init__(self, shelf: Shelf, client: viser.ClientHandle, count: int) -> None:
        """Build the switches in the folder of the panel that is open, and draw."""
        self.shelf, self.client, self.count = shelf, client, count
        self.drawing, self.moving, self.node = threading.Lock(), False, None
        self.stand: Stand | None = None
        self.chosen, self.places = 0.0, np.zeros(0, np.int64)
        gui = client.gui
        self.shown = gui.add_checkbox("splats", True)
        self.form = gui.add_dropdown("draw as", FORMS, initial_value=shelf.form, hint="Points are less work.")
        self.colors = gui.add_dropdown("colours", shelf.colors)
        self.budget = add_budget(gui, "most splats", count, shelf.most)
        self.near_me = gui.add_checkbox("finer where I am", True, hint=FINER)
        self.note = gui.add_markdown("")
        self.draw()
        for switch in (self.shown, self.form, self.colors, self.near_me):
            switch.on_update(telling(client, lambda _: self.draw()))
        self.budget.on_update(telling(client, Latest(self.draw)))
        self.following = Following(self._follow)
        client.camera.on_update(self.following.moved)
        self.following.moved()  # it may have, while the first splats were chosen

    @property
    def by_view(self) -> bool:
        """Whether the splats are chosen for the camera: there are more than the browser is to have."""
        return self.near_me.value and self.count > self.budget.value

    def draw(self) -> None:
        """Send what the switches say."""
        with self.drawing:
            for part in (self.form, self.colors, self.budget, self.near_me, self.note):
                part.visible = self.shown.value
            self.near_me.visible = self.shown.value and self.count > self.budget.value
            if self.shown.value:
                self._send()
            elif self.node is not None:
                self.node.remove()
                self.node = None

    def stop(self) -> None:
        """The browser has gone."""
        self.following.stop()

    def _send(self) -> None:
        colors: Colors = self.colors.value
        budget = min(self.budget.value, MOVING) if self.moving else self.budget.value
        as_points = self.moving or self.form.value == "points"
        if self.by_view:
            self.chosen, self.stand = time.monotonic(), None
            stand = Stand.of(self.client.camera)
            chosen, told = self.shelf.for_eye(budget, stand.eye)
            if Stand.of(self.client.camera).far_from(stand):
                return  # these are no longer wanted: the next ones are
            self.stand = stand
            found = self.shelf.drawn(chosen.table, colors)
            if not as_points:
                found = found.placed(self._places_of(chosen, budget), budget)
        else:
            found, told = self.shelf.splats(budget, colors)
        if as_points:
            self.node = add_points(self.client, "/splats", found.means, found.rgb, DOT * found.unit)
        else:
            self.node = self.client.scene.add_gaussian_splats(
                "/splats",
                found.means / found.unit,
                found.covariances,
                found.rgb,
                found.opacities[:, None],
                scale=WORLD * found.unit,
            )
        legend = {"height": f"; {self.shelf.height_words()}", "normal": "; red east, green north, blue up"}
        self.note.content = told + legend.get(colors, "")

    def _places_of(self, chosen: Chosen, budget: int) -> np.ndarray:
        """Places in the list of the browser, in which those stay that it has."""
        before = self.places if len(self.places) == budget else np.full(budget, -1)
        found = in_places(before, chosen.ids)
        self.places = np.full(budget, -1)
        self.places[found] = chosen.ids
        return found

    def _follow(self, moves: bool) -> None:
        """Points in the place of splats until the camera rests, and other splats where it has come to."""
        if not self.shown.value:
            return
        before, self.moving = self.moving, moves and self.form.value == "points-while-moving"
        try:
            if self.moving != before or (self.by_view and self._is_due(moves)):
                self.draw()
        except Exception as error:
            self.note.content = f"not updated: {' '.join(f'{type(error).__name__}: {error}'.split())}"

    def _is_due(self, moves: bool) -> bool:
        if moves and time.monotonic() - self.chosen < BETWEEN_S:
            return False
        here = Stand.of(self.client.camera)
        return self.stand is None or (here.far_from(self.stand) if moves else not here.same_as(self.stand))


def add_points(client: viser.ClientHandle, name: str, xyz: np.ndarray, rgb: np.ndarray, size: float) -> Any:
    """Draw (N, 3) local points, of a size in thousandths of a local unit."""
    return client.scene.add_point_cloud(
        name, xyz * WORLD, rgb, point_size=size * WORLD / 1000, precision="float32", point_shading="flat"
    )


def add_budget(gui: viser.GuiApi, label: str, count: int, most: int) -> viser.GuiSliderHandle[int]:
    """A slider for how many of `count` are shown, `most` of them at first; it ends where all are."""
    end = max(-(-count // STEP) * STEP, 1)
    return gui.add_slider(label, min(STEP, count, most), end, STEP, min(most, end))
