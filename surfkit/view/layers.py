"""Layers of the page: splats, mesh, sparse points, cameras, blocks; with their switches, in one browser."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from surfkit.core.check import BadInput
from surfkit.mesh.base import Mesh
from surfkit.view.display import PALETTE, Colors, some
from surfkit.view.glb import unlit_glb
from surfkit.view.outlines import block_outlines
from surfkit.view.picking import corners_of
from surfkit.view.shelf import Shelf

if TYPE_CHECKING:
    import viser

WORLD = 10.0
"""Units of the page per local unit: keys move the camera by two units of the page a second."""
SPLATS, TRIANGLES, POINTS = 1_000_000, 1_000_000, 500_000
"""Most that are sent to a browser, unless the user moves a slider."""
STEP = 10_000
REST_S = 0.4
"""A slider or a camera that has not moved for so long is at rest."""
TRAINED, HELD_OUT = (25, 40, 90), (210, 90, 0)
"""Colours of cameras."""
DOT = 1.5
"""Size of splats that are drawn as points, thousandths of a local unit."""
MOST_LABELS = 400
"""Blocks that get a label."""


class Latest:
    """Does what was asked for last, after a moment of rest: sliders send each place that they pass."""

    def __init__(self, action: Callable[[], None]) -> None:
        """Do `action`."""
        self.action, self.asked = action, 0

    def __call__(self, _event: Any = None) -> None:
        """Ask for it, and do it here if nobody asks again."""
        self.asked += 1
        mine = self.asked
        time.sleep(REST_S)
        if mine == self.asked:
            self.action()


def telling(client: viser.ClientHandle, action: Callable[..., None]) -> Callable[[Any], None]:
    """A callback that shows what a user can correct as a note on the page."""

    def guarded(event: Any) -> None:
        try:
            action(event)
        except (BadInput, OSError) as error:
            client.add_notification("That did not work", " ".join(str(error).split()), color="red")

    return guarded


class Layers:
    """What is drawn in one browser, and its switches."""

    def __init__(self, shelf: Shelf, client: viser.ClientHandle) -> None:
        """Build the switches, and draw."""
        self.shelf, self.client, self.subject = shelf, client, shelf.subject
        self.shows_mesh = self.subject.splats is None
        self.typical_size = self._typical_size()
        self.camera_size = self.typical_size if self.subject.views else 0.0
        gui = client.gui
        with gui.add_folder("Layers"):
            if self.subject.splats is not None:
                self._splat_switches(gui, len(self.subject.splats))
            if self.subject.mesh is not None:
                self._mesh_switches(gui, self.subject.mesh)
            if self.subject.points is not None:
                self._point_switches(gui)
            if self.subject.views:
                self._camera_switches(gui)
            if self.subject.plan is not None:
                shown = gui.add_checkbox("blocks", False)
                shown.on_update(telling(client, lambda _: self._blocks(shown.value)))

    def _splat_switches(self, gui: viser.GuiApi, count: int) -> None:
        shown = gui.add_checkbox("splats", True)
        form = gui.add_dropdown("draw as", ("splats", "points"), hint="Points are far less work for a slow machine.")
        colors = gui.add_dropdown("colours", self.shelf.colors)
        budget = gui.add_slider("most splats", min(STEP, count), _rounded(count), STEP, min(SPLATS, _rounded(count)))
        note = gui.add_markdown("")

        def draw() -> None:
            chosen: Colors = colors.value
            found, told = self.shelf.splats(budget.value, chosen)
            self.client.scene.remove_by_name("/splats")
            if form.value == "points":
                self.splats = self._add_points("/splats", found.means, found.rgb, DOT)
            else:
                self.splats = self.client.scene.add_gaussian_splats(
                    "/splats",
                    found.means / found.unit,
                    found.covariances,
                    found.rgb,
                    found.opacities[:, None],
                    scale=WORLD * found.unit,
                )
            self.splats.visible = shown.value
            legend = {"height": f"; {self.shelf.height_words()}", "normal": "; red east, green north, blue up"}
            note.content = told + legend.get(chosen, "")

        def show(_event: Any) -> None:
            self.splats.visible = shown.value
            for part in (form, colors, budget, note):
                part.visible = shown.value

        draw()
        shown.on_update(show)
        for choice in (form, colors):
            choice.on_update(telling(self.client, lambda _: draw()))
        budget.on_update(telling(self.client, Latest(draw)))

    def _mesh_switches(self, gui: viser.GuiApi, mesh: Mesh) -> None:
        count, most = len(mesh.faces), _rounded(len(mesh.faces))
        shown = gui.add_checkbox("mesh", self.shows_mesh)
        budget = gui.add_slider("most triangles", min(STEP, count), most, STEP, min(TRIANGLES, most))
        plain = gui.add_checkbox("mesh in grey", mesh.colors is None, disabled=mesh.colors is None)
        note = gui.add_markdown("")

        def draw() -> None:
            self.shows_mesh = shown.value
            for part in (budget, plain, note):
                part.visible = shown.value
            if not shown.value:
                self.client.scene.remove_by_name("/mesh")
                return
            found = self.shelf.mesh(budget.value)
            self._add_mesh(found, plain.value)
            note.content = (
                f"all {count:,} triangles are shown"
                if len(found.faces) == count
                else f"{len(found.faces):,} triangles stand for {count:,}; clicks meet all"
            )

        draw()
        for switch in (shown, plain):
            switch.on_update(telling(self.client, lambda _: draw()))
        budget.on_update(telling(self.client, Latest(draw)))

    def _add_mesh(self, mesh: Mesh, plain: bool) -> None:
        if plain or mesh.colors is None:
            self.client.scene.add_mesh_simple(
                "/mesh", mesh.vertices, mesh.faces, color=(190, 190, 190), side="double", scale=WORLD
            )
            return
        self.client.scene.add_glb("/mesh", unlit_glb(mesh), scale=WORLD, cast_shadow=False, receive_shadow=False)

    def _point_switches(self, gui: viser.GuiApi) -> None:
        points = self.subject.points
        assert points is not None
        alone = self.subject.splats is None and self.subject.mesh is None
        count = len(points.xyz)
        shown = gui.add_checkbox("points" if alone else "sparse points", alone)
        size = gui.add_slider("size of points", 0.5, 10, 0.5, 2.0)
        most = _rounded(count)
        budget = gui.add_slider("most points", min(STEP, count), most, STEP, min(POINTS, most))
        note = gui.add_markdown("")

        def draw() -> None:
            for part in (size, budget, note):
                part.visible = shown.value
            if not shown.value:
                self.client.scene.remove_by_name("/points")
                return
            rows = some(count, budget.value)
            self._add_points("/points", points.xyz[rows], points.rgb[rows], size.value)
            note.content = f"{len(rows):,} of {count:,} points are shown"

        draw()
        shown.on_update(telling(self.client, lambda _: draw()))
        for slider in (size, budget):
            slider.on_update(telling(self.client, Latest(draw)))

    def _add_points(self, name: str, xyz: np.ndarray, rgb: np.ndarray, size: float) -> Any:
        """Points of a size in thousandths of a local unit."""
        return self.client.scene.add_point_cloud(
            name, xyz * WORLD, rgb, point_size=size * WORLD / 1000, precision="float32", point_shading="flat"
        )

    def _camera_switches(self, gui: viser.GuiApi) -> None:
        shown = gui.add_checkbox("cameras", True, hint="Click on one to see its photograph. Orange ones were held out.")
        size = gui.add_slider("size of cameras", 0.2, 5.0, 0.1, 1.0)

        def draw() -> None:
            self.camera_size = self.typical_size * size.value if shown.value else 0.0
            size.visible = shown.value
            if not shown.value:
                self.client.scene.remove_by_name("/cameras")
                return
            centres, corners = corners_of([view.camera for view in self.subject.views], self.camera_size)
            held = np.arange(len(centres)) >= len(self.subject.scene.train)  # type: ignore[union-attr]
            colors = np.where(held[:, None], HELD_OUT, TRAINED).astype(np.uint8)
            self.client.scene.add_line_segments(
                "/cameras",
                frustum_lines(centres, corners) * WORLD,
                np.broadcast_to(np.repeat(colors, 8, axis=0)[:, None], (8 * len(centres), 2, 3)),
                thickness=1.5,
                thickness_units="screen",
            )

        draw()
        shown.on_update(telling(self.client, lambda _: draw()))
        size.on_update(telling(self.client, Latest(draw)))

    def _blocks(self, shown: bool) -> None:
        scene = self.client.scene
        if not shown:
            scene.remove_by_name("/blocks")
            return
        plan = self.subject.plan
        assert plan is not None
        segments, owner, places = block_outlines(plan.cells, self.subject.positions(), self.subject.up)
        colors = np.broadcast_to(PALETTE[owner % len(PALETTE)][:, None], (len(owner), 2, 3))
        scene.add_frame("/blocks", show_axes=False)
        scene.add_line_segments("/blocks/lines", segments * WORLD, colors, thickness=2.5, thickness_units="screen")
        for block, place in zip(plan.blocks[:MOST_LABELS], places, strict=False):
            text = f"block {block.index}: {len(block.views)} views"
            scene.add_label(f"/blocks/{block.index}", text, position=place * WORLD, anchor="bottom-center")

    def _typical_size(self) -> float:
        """Of the pictures of cameras, local units: they do not hide one another."""
        if not self.subject.views:
            return 0.0
        centres = np.stack([view.camera.centre.numpy() for view in self.subject.views])
        reach = float(np.linalg.norm(centres - centres.mean(0), axis=1).max())
        return 0.8 * reach / max(np.sqrt(len(centres)), 3.0) if reach > 0 else 0.1


def frustum_lines(centres: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(8 V, 2, 3) segments of (V, 3) centres and (V, 4, 3) corners: four rays and four sides of each."""
    rays = np.stack([np.broadcast_to(centres[:, None], corners.shape), corners], axis=2)
    sides = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2)
    return np.concatenate([rays, sides], axis=1).reshape(-1, 2, 3).astype(np.float32)


def _rounded(count: int) -> int:
    """The end of a slider: a whole number of steps, or what there is."""
    return max(-(-count // STEP) * STEP, 1)
