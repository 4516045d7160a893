"""A mesh in one browser: its colours, and how many triangles."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

from surfkit.apps.view.browser_camera import WORLD, Debouncer, quaternion_of, telling
from surfkit.apps.view.draw_limits import DrawPace
from surfkit.apps.view.escape_text import as_text
from surfkit.apps.view.mesh_files import TexturedGlb
from surfkit.apps.view.shared_cache import SharedCache
from surfkit.apps.view.splat_layer import add_budget
from surfkit.apps.view.unlit_glb import unlit_glb
from surfkit.mesh.base import Mesh

if TYPE_CHECKING:
    import viser

MESH_KIND = "triangles"
OWN_COLORS = "colours"
"""In the choice of colours, beside the values of the vertices."""
MAX_UNASKED_BYTES = 64_000_000
"""Bytes of pictures and triangles up to which a browser is sent them without being asked."""


class MeshLayer:
    """Draws the mesh, again when a switch is moved or the browser can draw more or fewer triangles.

    They are as many while the camera rests as while it moves: a mesh that is sent again is not seen for a moment.

    Attributes:
        moves: Whether the camera does.
    """

    def __init__(self, shelf: SharedCache, client: viser.ClientHandle, pace: DrawPace, mesh: Mesh) -> None:
        """Build the switches in the folder of the panel that is open, and draw."""
        self.shelf, self.client, self.pace, self.count = shelf, client, pace, len(mesh.faces)
        self.drawing, self.moves, self.asked = threading.Lock(), True, 0
        self.textured, bare = shelf.subject.textured, mesh.colors is None and shelf.subject.textured is None
        sent = self.textured is not None and self.textured.path.stat().st_size <= MAX_UNASKED_BYTES
        gui = client.gui
        self.shown = gui.add_checkbox("mesh", shelf.subject.splats is None)
        self.budget = add_budget(gui, "most triangles", self.count, shelf.most)
        self.pictures = gui.add_checkbox("mesh with pictures", sent)
        self.plain = gui.add_checkbox("mesh in grey", bare and not mesh.values, disabled=bare and not mesh.values)
        given = () if mesh.colors is None else (OWN_COLORS,)
        self.by = gui.add_dropdown("colours of the mesh", (*given, *mesh.values)) if mesh.values else None
        self.note = gui.add_markdown("")
        self.draw()
        for switch in (self.shown, self.pictures, self.plain, *([self.by] if self.by is not None else [])):
            switch.on_update(telling(client, lambda _: self.draw()))
        self.budget.on_update(telling(client, Debouncer(self.draw)))

    @property
    def whole(self) -> bool:
        """Whether the mesh is drawn as it is in its file, with pictures."""
        return self.textured is not None and self.pictures.value and not self.plain.value and self.value is None

    @property
    def value(self) -> str | None:
        """Which value of the vertices colours the mesh; None for its own colours."""
        return None if self.by is None or self.plain.value or self.by.value == OWN_COLORS else self.by.value

    def wanted(self) -> int:
        """Triangles that are to be drawn now, at most."""
        return self.pace.allowed(MESH_KIND, min(self.budget.value, self.count), moves=True)

    def draw(self) -> None:
        """Send what the switches say."""
        with self.drawing:
            shown = self.shown.value
            self.budget.visible = shown and not self.whole
            self.pictures.visible = shown and self.textured is not None
            self.plain.visible = self.note.visible = shown
            if self.by is not None:
                self.by.visible = shown and not self.plain.value
            self.asked = self.wanted()
            if not self.shown.value:
                self.client.scene.remove_by_name("/mesh")
            elif self.textured is not None and self.whole:
                self.note.content = self._add_textured(self.textured)
            elif self.value is None:
                self.note.content = self._add_mesh(self.shelf.mesh(self.asked))
            else:
                mesh, words = self.shelf.mesh_by(self.value, self.asked)
                self.note.content = f"{words}. {self._add_mesh(mesh)}"

    def follow(self) -> None:
        """Draw as many triangles as the browser can draw in time while the camera moves, or rests."""
        if self.shown.value and not self.whole and self.wanted() != self.asked:
            self.draw()

    def _add_mesh(self, mesh: Mesh) -> str:
        """Triangles that stand for all; which they are, in words."""
        if self.plain.value or mesh.colors is None:
            self.client.scene.add_mesh_simple(
                "/mesh", mesh.vertices, mesh.faces, color=(190, 190, 190), side="double", scale=WORLD
            )
        else:
            self.client.scene.add_glb("/mesh", unlit_glb(mesh), scale=WORLD, cast_shadow=False, receive_shadow=False)
        most = min(self.budget.value, self.count)
        self.pace.sent(MESH_KIND, len(mesh.faces), most, each=3)
        if len(mesh.faces) == self.count:
            return f"all {self.count:,} triangles are shown"
        words = self.pace.words(MESH_KIND, most, moves=True)
        return f"{len(mesh.faces):,} triangles stand for {self.count:,}; clicks meet all{words}"

    def _add_textured(self, textured: TexturedGlb) -> str:
        """A file as it is, in its place; which it is, in words."""
        frame, place, data = self.shelf.subject.frame, textured.place, textured.path.read_bytes()
        self.client.scene.add_glb(
            "/mesh",
            data,
            scale=WORLD * frame.scale,
            wxyz=quaternion_of(place.turn.T),
            position=WORLD * frame.to_local(place.offset),
            cast_shadow=False,
            receive_shadow=False,
        )
        return f"{as_text(textured.path.name)} is shown, {len(data) / 1e6:.1f} MB"
