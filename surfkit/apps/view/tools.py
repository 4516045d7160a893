"""Tools of one browser: measuring, a crop box, a path of the camera."""

from __future__ import annotations

import math
import shlex
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from surfkit.apps.view.browser_camera import WORLD, pose_of, stand_at, telling
from surfkit.apps.view.crop_box import edges, sizes, turned_box, upright_axis
from surfkit.apps.view.escape_text import as_code, as_text
from surfkit.apps.view.film import FilmTool
from surfkit.apps.view.keyframes import KeyPath, write_path
from surfkit.apps.view.layers import frustum_lines
from surfkit.apps.view.measure_clicks import coordinates, in_words, measured, path_lines, shown
from surfkit.apps.view.picking import corners_of
from surfkit.apps.view.shared_cache import SharedCache
from surfkit.core.check import BadInput
from surfkit.scene.crop import Crop, write_crop

if TYPE_CHECKING:
    import viser

MEASURE_COLOR, PATH_COLOR = (230, 40, 40), (20, 120, 230)
BOX_COLOR = (20, 160, 60)
MARK_SIZE = 0.006
"""Size of what is marked, local units at a distance of 1."""
CROP_PERCENTILES = (5, 95)
"""Percentiles of the positions at the corners of a new crop box."""
PREVIEW_S = 0.04
"""Between two steps of a preview."""
WRITING_LOCK = threading.Lock()


class MeasureTool:
    """Coordinates of what is clicked, and lengths and areas of what was clicked one after the other."""

    def __init__(self, shelf: SharedCache, client: viser.ClientHandle) -> None:
        """Build the panel."""
        self.shelf, self.client = shelf, client
        self.points: list[np.ndarray] = []
        gui = client.gui
        self.folder = gui.add_folder("Measure")
        with self.folder:
            self.place = gui.add_markdown("Click on the surface to see its coordinates.")
            self.on = gui.add_checkbox("measure", False, hint="Each click adds a point of a line.")
            self.closed = gui.add_checkbox("close the line", False, visible=False)
            self.result = gui.add_markdown("", visible=False)
            self.less = gui.add_button_group("points", ("remove last", "clear"), visible=False)
        self.on.on_update(telling(client, lambda _: self._switch()))
        self.closed.on_update(telling(client, lambda _: self._draw()))
        self.less.on_click(telling(client, lambda event: self._fewer(event.target.value)))

    def click(self, place: np.ndarray | None) -> None:
        """What was clicked: a (3,) local place, or nothing."""
        if place is None:
            self.place.content = "There is no surface where you clicked."
            self.client.scene.remove_by_name("/clicked")
            return
        subject = self.shelf.subject
        self.place.content = as_text(coordinates(place, subject.frame, subject.up))
        self._mark("/clicked", place, PATH_COLOR)
        if self.on.value:
            self.points.append(place)
            self._draw()

    def _switch(self) -> None:
        for part in (self.closed, self.result, self.less):
            part.visible = self.on.value
        self._draw()

    def _fewer(self, word: str) -> None:
        self.points = [] if word == "clear" else self.points[:-1]
        self._draw()

    def _draw(self) -> None:
        scene, subject = self.client.scene, self.shelf.subject
        scene.remove_by_name("/measure")
        if not self.on.value:
            return
        unit = (subject.frame.metres or 1.0) / subject.frame.scale
        found = measured(np.array(self.points), subject.up, unit)
        self.result.content = in_words(found, subject.frame, len(self.points))
        scene.add_frame("/measure", show_axes=False)
        for at, point in enumerate(self.points):
            self._mark(f"/measure/{at}", point, MEASURE_COLOR)
        segments = path_lines(self.points, self.closed.value)
        if len(segments):
            scene.add_line_segments(
                "/measure/line", segments * WORLD, MEASURE_COLOR, thickness=3, thickness_units="screen"
            )
        name = "m" if subject.frame.metres else "units"
        for at, (start, end) in enumerate(segments):
            text = f"{shown(float(np.linalg.norm(end - start)) * unit)} {name}"
            scene.add_label(f"/measure/label{at}", text, position=(start + end) / 2 * WORLD, anchor="bottom-center")

    def _mark(self, name: str, place: np.ndarray, color: tuple[int, int, int]) -> None:
        away = float(np.linalg.norm(place - np.asarray(self.client.camera.position) / WORLD))
        self.client.scene.add_icosphere(name, MARK_SIZE * away * WORLD, color, position=place * WORLD)


class CropTool:
    """A box with two corners to drag, written as a crop file in the frame of the data set."""

    def __init__(self, shelf: SharedCache, client: viser.ClientHandle, folder: Path) -> None:
        """Build the panel; files go into `folder`."""
        self.shelf, self.client, self.folder = shelf, client, folder
        subject = shelf.subject
        self.axis = upright_axis(subject.up)
        places = subject.positions()
        places = places[:: max(1, len(places) // 200_000)].astype(np.float64)
        self.corners = [np.asarray(corner, np.float64) for corner in np.percentile(places, CROP_PERCENTILES, axis=0)]
        gui = client.gui
        with gui.add_folder("Crop box", expand_by_default=False):
            self.on = gui.add_checkbox("show the box", False, hint="Drag the arrows of its two corners.")
            self.heading = gui.add_slider("heading, degrees", -45.0, 45.0, 0.5, 0.0)
            self.told = gui.add_markdown("")
            write = gui.add_button("write crop file")
            self.written = gui.add_markdown("")
        self.on.on_update(telling(client, lambda _: self._show()))
        self.heading.on_update(telling(client, lambda _: self._draw()))
        write.on_click(telling(client, lambda _: self._write()))

    @property
    def crop(self) -> Crop:
        """The box as it is drawn, in the frame of the input."""
        one, other = (self.shelf.subject.frame.to_input(corner) for corner in self.corners)
        return turned_box(one, other, float(self.heading.value), self.axis)

    def _show(self) -> None:
        scene = self.client.scene
        scene.remove_by_name("/crop")
        if not self.on.value:
            return
        scene.add_frame("/crop", show_axes=False)
        for at, corner in enumerate(self.corners):
            handle = scene.add_transform_controls(
                f"/crop/corner{at}", scale=1.0, disable_rotations=True, disable_sliders=True, position=corner * WORLD
            )
            handle.on_update(telling(self.client, lambda event, at=at: self._drag(at, event.target.position)))
        self._draw()

    def _drag(self, at: int, position: Any) -> None:
        self.corners[at] = np.asarray(position, np.float64) / WORLD
        self._draw()

    def _draw(self) -> None:
        if not self.on.value:
            return
        frame = self.shelf.subject.frame
        lines = frame.to_local(edges(self.crop)).astype(np.float32)
        self.client.scene.add_line_segments(
            "/crop/box", lines * WORLD, BOX_COLOR, thickness=3, thickness_units="screen"
        )
        name, unit = ("m", frame.metres) if frame.metres else ("units", 1.0)
        first, second, height = (shown(size * unit) for size in sizes(self.crop))
        self.told.content = f"{first} × {second} {name} on the ground, {height} {name} high"

    def _write(self) -> None:
        path, source = free_name(self.folder, "crop"), self.shelf.subject.path
        with WRITING_LOCK:
            self.folder.mkdir(parents=True, exist_ok=True)
            write_crop(path, self.crop)
        run = shlex.quote(str(source)) if source.is_dir() else "RUN"
        self.written.content = (
            f"Written. Use it with\n\n{as_code(f'surfkit mesh {run} --crop {shlex.quote(str(path))}')}"
        )


class PathTool:
    """Key views of a path, its preview, and its file."""

    def __init__(self, shelf: SharedCache, client: viser.ClientHandle, folder: Path, closing: threading.Event) -> None:
        """Build the panel; files go into `folder`, and a preview ends when the server is `closing`."""
        self.shelf, self.client, self.folder, self.closing = shelf, client, folder, closing
        self.poses: list[np.ndarray] = []
        self.playing = threading.Event()
        self.saved: tuple[Any, Path, int] | None = None
        gui = client.gui
        panel = gui.add_folder("Camera path", expand_by_default=False)
        with panel:
            add = gui.add_button("add this view")
            fewer = gui.add_button_group("key views", ("remove last", "clear"))
            self.seconds = gui.add_number("seconds", 10.0, min=0.1, max=3600.0, step=0.1)
            self.fps = gui.add_number("frames a second", 30, min=1, max=120, step=1)
            self.fov = gui.add_slider("field of view, degrees", 10, 120, 1, round(math.degrees(client.camera.fov)))
            play = gui.add_button("preview")
            write = gui.add_button("write path file")
            self.told = gui.add_markdown("")
        add.on_click(telling(client, lambda _: self._add()))
        fewer.on_click(telling(client, lambda event: self._fewer(event.target.value)))
        play.on_click(telling(client, lambda _: self._play()))
        write.on_click(telling(client, lambda _: self._write()))
        if shelf.subject.draw is not None:
            FilmTool(shelf, client, panel, lambda: self._save()[0], closing)

    @property
    def keys(self) -> KeyPath:
        """What the panel says."""
        return KeyPath(tuple(self.poses), float(self.seconds.value), float(self.fps.value), float(self.fov.value))

    def _add(self) -> None:
        self.poses.append(pose_of(self.client.camera))
        self._draw()

    def _fewer(self, word: str) -> None:
        self.poses = [] if word == "clear" else self.poses[:-1]
        self._draw()

    def _draw(self) -> None:
        scene = self.client.scene
        scene.remove_by_name("/path")
        self.told.content = f"{len(self.poses)} key views"
        if len(self.poses) < 2:
            return
        keys = self.keys
        cameras = KeyPath(keys.poses, 20.0 * len(keys.poses), 1.0, keys.fov_degrees).cameras()
        centres = np.stack([camera.centre.numpy() for camera in cameras])
        scene.add_frame("/path", show_axes=False)
        lines = path_lines(list(centres), closed=False)
        scene.add_line_segments("/path/line", lines * WORLD, PATH_COLOR, thickness=3, thickness_units="screen")
        frames = frustum_lines(*corners_of(cameras[::10], 0.05))
        scene.add_line_segments("/path/frames", frames * WORLD, PATH_COLOR, thickness=1, thickness_units="screen")

    def _play(self) -> None:
        """Fly along the path, in the time that it takes; a second click stops it."""
        if self.playing.is_set():
            self.stop()
            return
        cameras, keys = self.keys.cameras(), self.keys
        before, self.client.camera.fov = self.client.camera.fov, math.radians(keys.fov_degrees)
        self.playing.set()
        begun = time.monotonic()
        while self.playing.is_set() and (gone := time.monotonic() - begun) < keys.seconds:
            at = min(int(gone / keys.seconds * len(cameras)), len(cameras) - 1)
            stand_at(self.client, cameras[at].world_to_camera.numpy(), 1.0)
            if self.closing.wait(PREVIEW_S):
                return
        self.playing.clear()
        self.client.camera.fov = before

    def stop(self) -> None:
        """End the preview."""
        self.playing.clear()

    def _save(self) -> tuple[Path, int]:
        """The file of the path, written unless it is the same as before, and how many frames it has."""
        keys = self.keys
        same = [pose.tolist() for pose in keys.poses], keys.seconds, keys.fps, keys.fov_degrees
        if self.saved is None or self.saved[0] != same or not self.saved[1].exists():
            with WRITING_LOCK:
                path = free_name(self.folder, "path")
                self.saved = same, path, write_path(path, keys, self.shelf.subject.frame)
        return self.saved[1:]

    def _write(self) -> None:
        path, frames = self._save()
        subject = self.shelf.subject
        run = shlex.quote(str(subject.path)) if subject.path.is_dir() else "RUN"
        video = shlex.quote(str(path.with_suffix(".mp4")))
        command = f"surfkit render {run} --path {shlex.quote(str(path))} --size 1920x1080 --out {video}"
        self.told.content = f"{frames} frames written. The video is made by\n\n{as_code(command)}"


def free_name(folder: Path, stem: str) -> Path:
    """STEM.json in a folder, or STEM-2.json and so on where that is taken: nothing is replaced."""
    number = 1
    while (path := folder / (f"{stem}.json" if number == 1 else f"{stem}-{number}.json")).exists():
        number += 1
        if number > 10_000:
            raise BadInput(f"{folder}: too many files named {stem}; delete some")
    return path
