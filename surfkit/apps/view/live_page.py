"""What one browser shows of a training: a picture of where it stands, or of a training camera beside its photograph."""

from __future__ import annotations

import math
import threading
import time
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
import torch

from surfkit.apps.render.frame_files import view_of
from surfkit.apps.render.path import beside, middle_of, up_of
from surfkit.apps.view.browser_camera import WORLD, pose_of, ray_of, set_value, stand_at, telling, whole_view
from surfkit.apps.view.control import TrainingControl
from surfkit.apps.view.cursor import Cursor
from surfkit.apps.view.error_pictures import picture
from surfkit.apps.view.escape_text import as_text
from surfkit.apps.view.framed_pictures import FramedPictures, framed, window_of
from surfkit.apps.view.layers import TRAINED_COLOR, frustum_lines, typical_size
from surfkit.apps.view.measure_clicks import coordinates
from surfkit.apps.view.photo_comparison import TURNING_DISTANCE
from surfkit.apps.view.picking import corners_of, hit_camera, surface_depth
from surfkit.core.check import BadInput
from surfkit.scene.camera import Camera
from surfkit.scene.scene import Scene, View

if TYPE_CHECKING:
    import viser

Kind = Literal["render", "depth", "normal"]
Place = Literal["where I am", "a training camera"]
FREE_PLACE, CAMERA_PLACE = get_args(Place)
MIN_PICTURE_PX, MAX_PICTURE_PX, DEFAULT_PICTURE_PX, PICTURE_STEP_PX = 160, 1600, 640, 80
"""Of the longer side of a picture, pixels."""
REFRESH_S = 2.0
"""Between two pictures from the same place: only the training has changed them."""
JPEG_QUALITY = 85
NO_COORDINATES_NOTE = "no coordinates are shown"


@dataclass(frozen=True)
class SceneWithoutModel:
    """A scene to look at, before there is a model of it."""

    scene: Scene

    @property
    def views(self) -> tuple[View, ...]:
        """All cameras, those of held-out photographs last."""
        return (*self.scene.train, *self.scene.held_out)

    @cached_property
    def held_out(self) -> frozenset[str]:
        """Names of the held-out photographs."""
        return frozenset(view.name for view in self.scene.held_out)

    @cached_property
    def centres(self) -> np.ndarray:
        """(V, 3) of the cameras."""
        return np.stack([view.camera.centre.numpy() for view in self.views])

    @cached_property
    def size(self) -> float:
        """Of the pictures of cameras, local units."""
        return typical_size(self.centres)

    @cached_property
    def first(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Up, where one stands at first, and what one looks at: as far away as the cameras, half from above."""
        up, middle = up_of(self.scene), middle_of(self.scene)
        reach = float(np.median(np.linalg.norm(self.centres - middle, axis=1))) or 1.0
        east, north = beside(up)
        return up, middle + reach * (0.3 * east - north + 0.8 * up), middle


class LivePage:
    """The panel of one browser, and its picture.

    Attributes:
        around: The scene; None before it is known.
        drawn: When the last picture was done, seconds of `time.monotonic`.
        received: When the training had drawn it, or had been asked in vain, seconds of `time.perf_counter`.
        shown: The picture, if its depths are known.
    """

    def __init__(
        self, control: TrainingControl, client: viser.ClientHandle, wake: threading.Event, script: bool
    ) -> None:
        """Build the panel.

        Args:
            control: Draws.
            client: The browser.
            wake: Set when a picture is wanted.
            script: Whether the page can tell where the pointer is.
        """
        self.control, self.client, self.wake = control, client, wake
        self.shown: FramedPictures | None = None
        self.around: SceneWithoutModel | None = None
        self.dirty, self.index, self.drawn, self.received = True, -1, 0.0, 0.0
        self.photo: tuple[tuple[str, int], np.ndarray] | None = None
        gui = client.gui
        folder = gui.add_folder("Live picture", order=2)
        with folder:
            self.kind = gui.add_dropdown("show", get_args(Kind))
            self.place = gui.add_dropdown("from", get_args(Place))
            self.number = gui.add_number("camera", 1, min=1, max=1, step=1)
            step = gui.add_button_group("go to", ("previous", "next", "stand there"))
            self.cameras = gui.add_checkbox("cameras", False, hint="Click on one to see it beside its photograph.")
            self.longest = gui.add_slider("pixels", MIN_PICTURE_PX, MAX_PICTURE_PX, PICTURE_STEP_PX, DEFAULT_PICTURE_PX)
            self.told = gui.add_markdown("")
        self.cursor = Cursor(client, folder, self._under) if script else None
        if self.cursor is not None:
            self.cursor.on.on_update(telling(client, lambda _: self._ask()))
        for switch in (self.kind, self.place, self.longest):
            switch.on_update(telling(client, lambda _: self._changed()))
        self.number.on_update(telling(client, self._numbered))
        step.on_click(telling(client, lambda event: self._step(event.target.value)))
        self.cameras.on_update(telling(client, lambda _: self._draw_cameras()))
        client.camera.on_update(self._moved)
        client.scene.on_click()(telling(client, self._click))

    def enter(self, around: SceneWithoutModel) -> None:
        """Show another scene; the first one is looked at from where all of it is seen."""
        first, self.around, self.photo, self.shown = self.around is None, around, None, None
        self.number.max = len(around.views)
        set_value(self.number, min(int(self.number.value), len(around.views)))
        if first:
            up, at, middle = around.first
            with self.client.atomic():
                self.client.camera.up_direction = up
                self.client.camera.position, self.client.camera.look_at = at * WORLD, middle * WORLD
        self._changed()

    def wants(self, now: float) -> bool:
        """Whether it is time for another picture: one has moved, or steps were made meanwhile."""
        if self.around is None:
            return False
        return self.dirty or (self.index != self.control.index and now - self.drawn >= REFRESH_S)

    def draw(self) -> None:
        """Have the picture drawn, and show it.

        Raises:
            BadInput: There is no stage to draw, or it draws no such maps.
        """
        self.dirty, self.index, self.received = False, self.control.index, time.perf_counter()
        try:
            self._draw()
        finally:
            self.drawn = time.monotonic()

    def tell_failed(self, said: str) -> None:
        """Show why there is no picture; nothing when there is one."""
        if said:
            self.told.content = f"no picture: {as_text(said)}"

    def _draw(self) -> None:
        around, kind = self.around, self.kind.value
        assert around is not None, "no picture is wanted before there is a scene"
        chosen = self._chosen(around) if self.place.value == CAMERA_PLACE else None
        camera = self._camera() if chosen is None else chosen.camera.fitted(int(self.longest.value))
        view = replace(chosen, camera=camera) if chosen is not None else view_of(camera)
        following = self.cursor is not None and self.cursor.on.value
        try:
            drawing = self.control.draw(view, kind != "render" or following)
        finally:
            self.received = time.perf_counter()
        image, told = picture(view, kind, lambda _: drawing.maps, around.scene.frame)
        images, window = [image], image.shape[:2]
        if chosen is not None:
            images, told = self._beside_photograph(around, view, image, told)
            window = window_of((image.shape[0], len(images) * image.shape[1]), self.client.camera.aspect)
        depth = surface_depth(drawing.maps) if following else None
        self.client.scene.set_background_image(framed(images, window), format="jpeg", jpeg_quality=JPEG_QUALITY)
        self.index = drawing.index
        self.shown = None if depth is None else FramedPictures(view.camera, depth.numpy(), len(images), window)
        self.told.content = f"After step {drawing.index:,}: {told}"
        if self.cursor is not None:
            self.cursor.changed()

    def _under(self, x: float, y: float) -> str:
        """Coordinates of what the picture shows under the pointer; see `cursor.Say`."""
        shown, around = self.shown, self.around
        if shown is None or around is None:
            return ""
        place = shown.place(0.5 + x / (2 * self.client.camera.aspect), 0.5 + y / 2)
        return "" if place is None else coordinates(place, around.scene.frame, around.first[0])

    def _chosen(self, around: SceneWithoutModel) -> View:
        return around.views[int(self.number.value) - 1]

    def _camera(self) -> Camera:
        """That of the browser."""
        at = self.client.camera
        by = max(at.image_width, at.image_height) / float(self.longest.value)
        width, height = max(1, round(at.image_width / by)), max(1, round(at.image_height / by))
        focal = height / 2 / math.tan(at.fov / 2)
        return Camera(torch.from_numpy(pose_of(at)), focal, focal, width / 2, height / 2, width, height)

    def _beside_photograph(
        self, around: SceneWithoutModel, view: View, image: np.ndarray, told: str
    ) -> tuple[list[np.ndarray], str]:
        """The photograph, and a picture of its camera."""
        key = view.name, view.camera.width
        if self.photo is None or self.photo[0] != key:
            try:
                self.photo = key, picture(view, "photograph", None, around.scene.frame)[0]
            except BadInput as error:
                return [image], f"{error}. {told}"
        held = " (held out)" if view.name in around.held_out else ""
        return [self.photo[1], image], f"**{view.name}**{held} beside the picture; {told}"

    def _changed(self) -> None:
        self._draw_cameras()
        self._ask()

    def _ask(self) -> None:
        self.dirty = True
        self.wake.set()

    def _moved(self, _camera: Any) -> None:
        if self.place.value == FREE_PLACE:
            self._ask()

    def _numbered(self, event: Any) -> None:
        if event.client is not None:
            set_value(self.place, CAMERA_PLACE)
            self._changed()

    def _step(self, word: str) -> None:
        if self.around is None:
            raise BadInput("there is no camera yet: the data set is not read")
        if word == "stand there":
            camera = self._chosen(self.around).camera
            stand_at(self.client, camera.world_to_camera.numpy(), TURNING_DISTANCE)
            self.client.camera.fov = whole_view(camera, self.client.camera.aspect)
            set_value(self.place, FREE_PLACE)
        else:
            at = int(self.number.value) - 1 + (1 if word == "next" else -1)
            set_value(self.number, at % len(self.around.views) + 1)
            set_value(self.place, CAMERA_PLACE)
        self._changed()

    def _click(self, event: viser.SceneClickEvent) -> None:
        if self.around is None or not self.cameras.value or self.place.value == CAMERA_PLACE:
            return
        _, corners = corners_of([view.camera for view in self.around.views], self.around.size)
        met = hit_camera(corners, *ray_of(event))
        if met is not None:
            set_value(self.number, met + 1)
            set_value(self.place, CAMERA_PLACE)
            self._changed()

    def _draw_cameras(self) -> None:
        """Outlines of the cameras, over the picture from where one stands."""
        if self.around is None or not self.cameras.value or self.place.value == CAMERA_PLACE:
            self.client.scene.remove_by_name("/cameras")
            return
        lines = frustum_lines(*corners_of([view.camera for view in self.around.views], self.around.size))
        self.client.scene.add_line_segments(
            "/cameras", lines * WORLD, TRAINED_COLOR, thickness=1.5, thickness_units="screen"
        )
