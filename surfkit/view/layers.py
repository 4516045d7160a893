"""Layers of the page: splats, mesh, sparse points, cameras, blocks; with their switches, in one browser."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from surfkit.mesh.base import Mesh
from surfkit.view.display import PALETTE
from surfkit.view.glb import unlit_glb
from surfkit.view.mesh_files import Textured
from surfkit.view.outlines import block_outlines
from surfkit.view.pace import Pace
from surfkit.view.picking import corners_of
from surfkit.view.point_layer import PointLayer
from surfkit.view.screen import WORLD, Following, Latest, quaternion_of, telling
from surfkit.view.shelf import Shelf
from surfkit.view.splat_layer import SplatLayer, add_budget

if TYPE_CHECKING:
    import viser

TRAINED, HELD_OUT = (25, 40, 90), (210, 90, 0)
"""Colours of cameras."""
SENT = 64_000_000
"""Bytes of pictures and triangles up to which a browser is sent them without being asked."""
MOST_LABELS = 400
"""Blocks that get a label."""


class Layers:
    """What is drawn in one browser, and its switches."""

    def __init__(self, shelf: Shelf, client: viser.ClientHandle, pace: Pace) -> None:
        """Build the switches, and draw."""
        self.shelf, self.client, self.subject = shelf, client, shelf.subject
        self.shows_mesh = self.subject.splats is None
        centres = [view.camera.centre.numpy() for view in self.subject.views]
        self.typical_size = typical_size(np.stack(centres)) if centres else 0.0
        self.camera_size = self.typical_size if self.subject.views else 0.0
        self.adapting: list[SplatLayer | PointLayer] = []
        gui = client.gui
        with gui.add_folder("Layers"):
            if self.subject.splats is not None or self.subject.points is not None:
                pace.add_switch()
            if self.subject.splats is not None:
                self.adapting.append(SplatLayer(shelf, client, pace, len(self.subject.splats)))
            if self.subject.mesh is not None:
                self._mesh_switches(gui, self.subject.mesh)
            if self.subject.points is not None:
                self.adapting.append(PointLayer(shelf, client, pace, self.subject.points))
            if self.subject.views:
                self._camera_switches(gui)
            if self.subject.plan is not None:
                shown = gui.add_checkbox("blocks", False)
                shown.on_update(telling(client, lambda _: self._blocks(shown.value)))

        self.following = Following(self._camera, pace.rest)
        pace.follow = self._follow
        client.camera.on_update(self.following.moved)
        self.following.moved()  # it may have, while the first splats were chosen

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
                layer.note.content = f"not updated: {' '.join(f'{type(error).__name__}: {error}'.split())}"

    def _mesh_switches(self, gui: viser.GuiApi, mesh: Mesh) -> None:
        count = len(mesh.faces)
        shown = gui.add_checkbox("mesh", self.shows_mesh)
        budget = add_budget(gui, "most triangles", count, self.shelf.most)
        textured, bare = self.subject.textured, mesh.colors is None and self.subject.textured is None
        sent = textured is not None and textured.path.stat().st_size <= SENT
        pictures = gui.add_checkbox("mesh with pictures", sent)
        plain = gui.add_checkbox("mesh in grey", bare, disabled=bare)
        note = gui.add_markdown("")

        def draw() -> None:
            self.shows_mesh = shown.value
            whole = textured is not None and pictures.value and not plain.value
            for part, sensible in ((budget, not whole), (pictures, textured is not None), (plain, True), (note, True)):
                part.visible = shown.value and sensible
            if not shown.value:
                self.client.scene.remove_by_name("/mesh")
            elif whole:
                note.content = self._add_textured(textured)
            else:
                note.content = self._add_mesh(self.shelf.mesh(budget.value), count, plain.value)

        draw()
        for switch in (shown, pictures, plain):
            switch.on_update(telling(self.client, lambda _: draw()))
        budget.on_update(telling(self.client, Latest(draw)))

    def _add_mesh(self, mesh: Mesh, count: int, plain: bool) -> str:
        """Triangles that stand for `count`; which they are, in words."""
        if plain or mesh.colors is None:
            self.client.scene.add_mesh_simple(
                "/mesh", mesh.vertices, mesh.faces, color=(190, 190, 190), side="double", scale=WORLD
            )
        else:
            self.client.scene.add_glb("/mesh", unlit_glb(mesh), scale=WORLD, cast_shadow=False, receive_shadow=False)
        if len(mesh.faces) == count:
            return f"all {count:,} triangles are shown"
        return f"{len(mesh.faces):,} triangles stand for {count:,}; clicks meet all"

    def _add_textured(self, textured: Textured) -> str:
        """A file as it is, in its place; which it is, in words."""
        frame, place, data = self.subject.frame, textured.place, textured.path.read_bytes()
        self.client.scene.add_glb(
            "/mesh",
            data,
            scale=WORLD * frame.scale,
            wxyz=quaternion_of(place.turn.T),
            position=WORLD * frame.to_local(place.offset),
            cast_shadow=False,
            receive_shadow=False,
        )
        return f"{textured.path.name} is shown, {len(data) / 1e6:.1f} MB"

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


def typical_size(centres: np.ndarray) -> float:
    """Of the pictures of cameras with (V, 3) centres, local units: they do not hide one another."""
    reach = float(np.linalg.norm(centres - centres.mean(0), axis=1).max())
    return 0.8 * reach / max(np.sqrt(len(centres)), 3.0) if reach > 0 else 0.1


def frustum_lines(centres: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(8 V, 2, 3) segments of (V, 3) centres and (V, 4, 3) corners: four rays and four sides of each."""
    rays = np.stack([np.broadcast_to(centres[:, None], corners.shape), corners], axis=2)
    sides = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2)
    return np.concatenate([rays, sides], axis=1).reshape(-1, 2, 3).astype(np.float32)
