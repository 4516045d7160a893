"""Splats in one browser: how many, in which colours, and as points where that is less work."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any

import numpy as np

from surfkit.view.display import Colors
from surfkit.view.screen import WORLD, Latest, telling
from surfkit.view.shelf import FORMS, Shelf

if TYPE_CHECKING:
    import viser

MOVING = 100_000
"""Points while the camera moves."""
STEP = 10_000
"""Of the sliders."""
DOT = 200.0
"""Size of splats that are drawn as points, thousandths of `Drawn.unit`: two standard deviations."""


class SplatLayer:
    """Draws the splats, and again when a switch is moved."""

    def __init__(self, shelf: Shelf, client: viser.ClientHandle, count: int) -> None:
        """Build the switches in the folder of the panel that is open, and draw."""
        self.shelf, self.client = shelf, client
        self.drawing, self.moving, self.node = threading.Lock(), False, None
        gui, most = client.gui, end_of(count)
        self.shown = gui.add_checkbox("splats", True)
        self.form = gui.add_dropdown("draw as", FORMS, initial_value=shelf.form, hint="Points are less work.")
        self.colors = gui.add_dropdown("colours", shelf.colors)
        self.budget = gui.add_slider("most splats", min(STEP, count), most, STEP, min(shelf.most, most))
        self.note = gui.add_markdown("")
        self.draw()
        for switch in (self.shown, self.form, self.colors):
            switch.on_update(telling(client, lambda _: self.draw()))
        self.budget.on_update(telling(client, Latest(self.draw)))
        self.rested = Latest(self._rest)
        client.camera.on_update(self._move)

    def draw(self) -> None:
        """Send what the switches say."""
        with self.drawing:
            for part in (self.form, self.colors, self.budget, self.note):
                part.visible = self.shown.value
            if self.node is not None:
                self.node.remove()
                self.node = None
            if not self.shown.value:
                return
            chosen: Colors = self.colors.value
            budget = min(self.budget.value, MOVING) if self.moving else self.budget.value
            found, told = self.shelf.splats(budget, chosen)
            if self.moving or self.form.value == "points":
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
            self.note.content = told + legend.get(chosen, "")

    def _move(self, _camera: Any) -> None:
        """Points in the place of splats, until the camera rests."""
        if self.form.value != "points-while-moving" or not self.shown.value:
            return
        if not self.moving:
            self.moving = True
            self.draw()
        self.rested()

    def _rest(self) -> None:
        self.moving = False
        self.draw()


def add_points(client: viser.ClientHandle, name: str, xyz: np.ndarray, rgb: np.ndarray, size: float) -> Any:
    """Draw (N, 3) local points, of a size in thousandths of a local unit."""
    return client.scene.add_point_cloud(
        name, xyz * WORLD, rgb, point_size=size * WORLD / 1000, precision="float32", point_shading="flat"
    )


def end_of(count: int) -> int:
    """The end of a slider: a whole number of steps that is not below what there is."""
    return max(-(-count // STEP) * STEP, 1)
