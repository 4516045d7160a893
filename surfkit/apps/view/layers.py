"""Layers of the page: splats, mesh, sparse points, cameras, blocks; with their switches, in one browser."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from surfkit.apps.view.browser_camera import WORLD, CameraFollower, Debouncer, telling
from surfkit.apps.view.browser_geometry import PALETTE
from surfkit.apps.view.draw_limits import DrawPace
from surfkit.apps.view.escape_text import as_text
from surfkit.apps.view.mesh_layer import MeshLayer
from surfkit.apps.view.outlines import block_outlines
from surfkit.apps.view.picking import corners_of
from surfkit.apps.view.point_layer import PointLayer
from surfkit.apps.view.shared_cache import SharedCache
from surfkit.apps.view.splat_layer import SplatLayer

if TYPE_CHECKING:
    import viser

TRAINED_COLOR, HELD_OUT_COLOR = (25, 40, 90), (210, 90, 0)
"""Colours of cameras."""
MAX_LABELLED_BLOCKS = 400
"""Blocks that get a label."""


class Layers:
    """What is drawn in one browser, and its switches."""

    def __init__(self, shelf: SharedCache, client: viser.ClientHandle, pace: DrawPace) -> None:
        """Build the switches, and draw."""
        self.shelf, self.client, self.subject = shelf, client, shelf.subject
        centres = [view.camera.centre.numpy() for view in self.subject.views]
        self.typical_size = typical_size(np.stack(centres)) if centres else 0.0
        self.camera_size = self.typical_size if self.subject.views else 0.0
        self.adapting: list[SplatLayer | MeshLayer | PointLayer] = []
        self.mesh: MeshLayer | None = None
        gui = client.gui
        with gui.add_folder("Layers"):
            pace.add_switch()
            if self.subject.splats is not None:
                self.adapting.append(SplatLayer(shelf, client, pace, len(self.subject.splats)))
            if self.subject.mesh is not None:
                self.mesh = MeshLayer(shelf, client, pace, self.subject.mesh)
                self.adapting.append(self.mesh)
            if self.subject.points is not None:
                self.adapting.append(PointLayer(shelf, client, pace, self.subject.points))
            if self.subject.views:
                self._camera_switches(gui)
            if self.subject.plan is not None:
                shown = gui.add_checkbox("blocks", False)
                shown.on_update(telling(client, lambda _: self._blocks(shown.value)))
        self.following = CameraFollower(self._camera, pace.rest)
        pace.follow = self._follow
        client.camera.on_update(self.following.moved)
        self.following.moved()  # it may have, while the first splats were chosen

    @property
    def shows_mesh(self) -> bool:
        """Whether clicks are to meet the mesh."""
        return self.mesh is not None and self.mesh.shown.value

    def stop(self) -> None:
        """The browser has gone."""
        self.following.stop()

    def _camera(self, moves: bool) -> None:
        for layer in self.adapting:
            layer.moves = moves
        self._follow()

    def _follow(self) -> None:
        for layer in self.adapting:
            try:
                layer.follow()
            except Exception as error:
                layer.note.content = f"not updated: {as_text(' '.join(f'{type(error).__name__}: {error}'.split()))}"

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
            colors = np.where(held[:, None], HELD_OUT_COLOR, TRAINED_COLOR).astype(np.uint8)
            self.client.scene.add_line_segments(
                "/cameras",
                frustum_lines(centres, corners) * WORLD,
                np.broadcast_to(np.repeat(colors, 8, axis=0)[:, None], (8 * len(centres), 2, 3)),
                thickness=1.5,
                thickness_units="screen",
            )

        draw()
        shown.on_update(telling(self.client, lambda _: draw()))
        size.on_update(telling(self.client, Debouncer(draw)))

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
        for block, place in zip(plan.blocks[:MAX_LABELLED_BLOCKS], places, strict=False):
            text = f"block {block.index}: {len(block.views)} views"
            scene.add_label(f"/blocks/{block.index}", text, position=place * WORLD, anchor="bottom-center")


def typical_size(centres: np.ndarray) -> float:
    """Of the pictures of cameras with (V, 3) centres, local units: they do not hide one another."""
    reach = float(np.linalg.norm(centres - centres.mean(0), axis=1).max())
    return 0.8 * reach / max(np.sqrt(len(centres)), 3.0) if reach > 0 else 0.1


def frustum_lines(centres: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(8 V, 2, 3) segments of (V, 3) centres and (V, 4, 3) corners: four rays and four sides of each."""
    rays = np.stack([np.broadcast_to(centres[:, None], corners.shape), corners], axis=2)
    sides = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2)
    return np.concatenate([rays, sides], axis=1).reshape(-1, 2, 3).astype(np.float32)
