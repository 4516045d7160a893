"""The cameras of a data set in one browser: their photographs, and what the model draws in their place."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import numpy as np

from surfkit.apps.view.browser_camera import REST_S, WORLD, quaternion_of, set_value, stand_at, telling, whole_view
from surfkit.apps.view.error_pictures import PICTURE_KINDS, Kind, picture, thumbnail
from surfkit.apps.view.escape_text import as_text
from surfkit.apps.view.layers import Layers
from surfkit.apps.view.picking import corners_of, hit_camera
from surfkit.apps.view.shared_cache import SharedCache
from surfkit.core.check import BadInput

if TYPE_CHECKING:
    import viser

THUMBNAIL_PX = 160
"""Of thumbnails, pixels; read only for the cameras that are near."""
MAX_NEARBY_THUMBNAILS = 60
AT_CAMERA_DISTANCE = 0.05
"""Distance up to which one stands at a camera, of the size of its picture."""
TURNING_DISTANCE = 0.5
"""Distance of the place about which the mouse turns when one stands at a camera, local units."""


class PhotoComparisonTool:
    """Chooses a camera, and shows what was seen and what is drawn from it."""

    def __init__(self, shelf: SharedCache, client: viser.ClientHandle, layers: Layers) -> None:
        """Build the panel; no photograph is read yet."""
        self.shelf, self.client, self.layers = shelf, client, layers
        self.views = shelf.subject.views
        self.cameras = [view.camera for view in self.views]
        self.centres = np.stack([camera.centre.numpy() for camera in self.cameras])
        self.chosen: int | None = None
        self.near: dict[int, Any] = {}
        self.moved = 0.0
        gui = client.gui
        with gui.add_folder("Photographs"):
            self.number = gui.add_number("camera", 1, min=1, max=len(self.views), step=1)
            step = gui.add_button_group("go to", ("previous", "next", "stand there"))
            self.kind = gui.add_dropdown("show", PICTURE_KINDS)
            self.plane = gui.add_checkbox("picture in place", True, hint="In the plane of the camera, in space.")
            self.follow = gui.add_checkbox("stand there on a click", True)
            self.few = gui.add_slider("thumbnails near me", 0, MAX_NEARBY_THUMBNAILS, 1, 0)
            self.told = gui.add_markdown("Click on a camera.")
            self.panel = gui.add_image(np.full((2, 3, 3), 255, np.uint8), visible=False)
        self.number.on_update(telling(client, lambda event: self._numbered(event)))
        step.on_click(telling(client, lambda event: self._step(event.target.value)))
        self.kind.on_update(telling(client, lambda _: self.show()))
        self.plane.on_update(telling(client, lambda _: self._place()))
        self.few.on_update(telling(client, lambda _: self._thumbnails()))
        client.camera.on_update(self._rest)

    def hit(self, origin: np.ndarray, direction: np.ndarray) -> int | None:
        """The camera whose picture a ray meets; None if none is shown there.

        The one at which the ray begins does not count: who stands at a camera sees the surface through its picture.
        """
        if not self.layers.camera_size:
            return None
        away = np.flatnonzero(
            np.linalg.norm(self.centres - origin, axis=1) > AT_CAMERA_DISTANCE * self.layers.camera_size
        )
        _, corners = corners_of([self.cameras[at] for at in away], self.layers.camera_size)
        met = hit_camera(corners, origin, direction)
        return None if met is None else int(away[met])

    def choose(self, at: int, *, stand: bool) -> None:
        """Show a camera, and stand there if that is wanted."""
        self.chosen = at
        if self.number.value != at + 1:
            set_value(self.number, at + 1)
        if stand:
            self.stand()
        self.show()

    def stand(self) -> None:
        """Move the browser's camera to the chosen one."""
        if self.chosen is None:
            raise BadInput("no camera is chosen yet: click on one, or give its number")
        camera = self.cameras[self.chosen]
        stand_at(self.client, camera.world_to_camera.numpy(), TURNING_DISTANCE)
        self.client.camera.fov = whole_view(camera, self.client.camera.aspect)

    def show(self) -> None:
        """Draw or read the picture of the chosen camera."""
        if self.chosen is None:
            return
        kind: Kind = self.kind.value
        view, subject = self.views[self.chosen], self.shelf.subject
        name = as_text(view.name)
        held = " (held out)" if self.chosen >= len(subject.scene.train) else ""  # type: ignore[union-attr]
        self.told.content = f"**{name}**{held}: {kind} ..."
        draw = self.shelf.draw if subject.draw is not None else None
        try:
            self.image, told = picture(view, kind, draw, subject.frame)
        except BadInput as error:
            self.told.content = f"**{name}**{held}: {as_text(error)}"
            self.panel.visible = False
            self.client.scene.remove_by_name("/chosen")
            raise
        self.told.content = f"**{name}**{held}. {told}"
        self.panel.image, self.panel.visible = self.image, True
        self._place()

    def _numbered(self, event: Any) -> None:
        if event.client is not None and self.number.value - 1 != self.chosen:
            self.choose(int(self.number.value) - 1, stand=self.follow.value)

    def _step(self, word: str) -> None:
        if word == "stand there":
            self.stand()
            return
        before = -1 if self.chosen is None else self.chosen
        self.choose((before + (1 if word == "next" else -1)) % len(self.views), stand=self.follow.value)

    def _place(self) -> None:
        """The picture in the plane of its camera."""
        if self.chosen is None or not self.plane.value:
            self.client.scene.remove_by_name("/chosen")
            return
        self._add_image("/chosen", self.chosen, self.image)

    def _add_image(self, name: str, at: int, image: np.ndarray) -> Any:
        size = self.layers.camera_size or self.layers.typical_size
        corners = corners_of([self.cameras[at]], size)[1][0]
        pose = self.cameras[at].world_to_camera.numpy()
        return self.client.scene.add_image(
            name,
            image,
            float(np.linalg.norm(corners[1] - corners[0])) * WORLD,
            float(np.linalg.norm(corners[3] - corners[0])) * WORLD,
            format="jpeg",
            wxyz=quaternion_of(pose),
            position=corners.mean(0) * WORLD,
        )

    def _rest(self, _camera: Any) -> None:
        """Read thumbnails when the browser's camera has come to rest."""
        if not self.few.value:
            return
        self.moved = mine = time.monotonic()
        time.sleep(REST_S)
        if self.moved == mine:
            telling(self.client, lambda _: self._thumbnails())(None)

    def _thumbnails(self) -> None:
        """Photographs of the nearest cameras in their planes, and of no others."""
        at = np.asarray(self.client.camera.position, np.float64) / WORLD
        nearest = np.argsort(np.linalg.norm(self.centres - at, axis=1))[: int(self.few.value)].tolist()
        for gone in set(self.near) - set(nearest):
            self.near.pop(gone).remove()
        for index in nearest:
            if index not in self.near:
                self.near[index] = self._add_image(f"/near/{index}", index, thumbnail(self.views[index], THUMBNAIL_PX))
