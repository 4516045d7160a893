"""A data set in Python."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from surfkit.api.listen import heard
from surfkit.api.splats import drawn
from surfkit.core.check import BadInput, expect
from surfkit.core.fit import fit, settings_of
from surfkit.io.datasets.data import Data, ReadSettings
from surfkit.io.datasets.read import read as read_scene
from surfkit.io.splats.splat_table import SplatTable
from surfkit.raster.api import Maps
from surfkit.raster.select import Device, select
from surfkit.scene.camera import Camera
from surfkit.scene.photos import read_photo
from surfkit.scene.scene import Frame, Scene, View
from surfkit.train.stage import Stage

MAX_SIDE = 32_768
"""Pixels of a side of a picture."""


@dataclass(frozen=True)
class Dataset:
    """Photographs with known cameras, as `read` gives them.

    Attributes:
        data: Where they are, and how they are read.
        scene: What was read, in the local frame; see `surfkit.Scene`.
        findings: What was noticed while they were read, one line each.
    """

    data: Data
    scene: Scene
    findings: tuple[str, ...] = ()

    def __repr__(self) -> str:
        """In one line: a notebook shows it."""
        photographs = f"{len(self.train)} photographs to train on, {len(self.held_out)} held out"
        return f"Dataset({str(self.data.path)!r}: {photographs}, {len(self.scene.cloud.xyz)} points)"

    @property
    def train(self) -> Sequence[View]:
        """The views that are trained on; `view.camera` is in the local frame."""
        return self.scene.train

    @property
    def held_out(self) -> Sequence[View]:
        """The views that are kept to measure with."""
        return self.scene.held_out

    @property
    def frame(self) -> Frame:
        """From the local frame to that of the input: `frame.to_input((N, 3))`, `frame.metres`, `frame.crs`."""
        return self.scene.frame

    @property
    def points(self) -> np.ndarray:
        """(P, 3) float64 sparse points, frame of the input."""
        return self.frame.to_input(self.scene.cloud.xyz.double().numpy())

    @property
    def colors(self) -> np.ndarray:
        """(P, 3) uint8 colours of the sparse points."""
        return self.scene.cloud.rgb.numpy()

    def camera(
        self,
        position: Sequence[float],
        target: Sequence[float],
        up: Sequence[float] = (0.0, 0.0, 1.0),
        like: View | None = None,
        size: tuple[int, int] | None = None,
        fov: float | None = None,
    ) -> Camera:
        """A camera that stands somewhere and looks at something.

        Args:
            position: (3,) frame of the input.
            target: (3,) frame of the input; it comes to the principal point.
            up: (3,) direction that is up in the picture.
            like: The view whose lens and size it has; by default the first one.
            size: Width and height, pixels; by default those of the view.
            fov: Angle that the width covers, degrees; by default that of the view.

        Raises:
            BadInput: The three do not give a direction, or an argument is of another shape.
        """
        lens = _lens((like or self.train[0]).camera, size, fov)
        given = {"position": position, "target": target, "up": up}
        places = {name: np.asarray(place, np.float64) for name, place in given.items()}
        for name, place in places.items():
            expect(f"camera: {name}", place, (3,))
            if not np.isfinite(place).all():
                raise BadInput(f"camera: {name} is {place}; give finite values")
        eye, at = (self.frame.to_local(places[name][None])[0] for name in ("position", "target"))
        forward = np.asarray(at, np.float64) - eye
        right = np.cross(forward, places["up"])
        if not np.linalg.norm(forward) > 0:
            raise BadInput(f"camera: position and target are both {places['target']}; give another target")
        if not np.linalg.norm(right) > 1e-9 * np.linalg.norm(forward):
            raise BadInput(f"camera: {position} looks at {target} along the direction that is up; give another `up`")
        forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = right, np.cross(forward, right), forward
        pose[:3, 3] = -pose[:3, :3] @ eye
        return replace(lens, world_to_camera=torch.from_numpy(pose))

    def photo(self, view: View) -> Tensor:
        """(3, H, W) float32 photograph of a view in [0, 1], at the size of its camera.

        Raises:
            BadInput: It cannot be read, or is no view.
        """
        if not isinstance(view, View):
            raise BadInput(f"photo: expected a view of the data set, such as scene.train[0], got {type(view).__name__}")
        size = view.camera.width, view.camera.height
        return read_photo(view.path, size, view.white, view.pixels).float() / 255

    def draw(self, splats: SplatTable, camera: Camera | View, device: Device = "auto") -> Maps:
        """What a camera sees of splats, with gradients: the result is differentiable in those tensors of `splats` that
        require it (`means`, `quats`, `log_scales`, `opacity_logits`, `sh0`, `sh_rest`), and not in the camera.

        Args:
            splats: Frame of the input, as of `run.splats` or `surfkit.read_splats`.
            camera: A view of this data set, or a camera in the local frame; `camera(...)` makes one.
            device: For drawing.

        Raises:
            BadInput: No splats or no camera, or values that are not finite.
        """
        if not isinstance(splats, SplatTable):
            raise BadInput(f"draw: expected splats as of run.splats or read_splats, got {type(splats).__name__}")
        return drawn(splats, view_of(camera, "draw").camera, self.frame, Stage().near, select(str(device))[0])


def view_of(camera: Camera | View, where: str) -> View:
    """A view of what is drawn; BadInput if it is neither a camera nor a view."""
    if isinstance(camera, View):
        return camera
    if not isinstance(camera, Camera):
        raise BadInput(
            f"{where}: expected a view of the data set or a surfkit.Camera, got {type(camera).__name__}; "
            "scene.camera(position, target) makes one"
        )
    return View("camera", camera, Path("camera"))


def _lens(camera: Camera, size: tuple[int, int] | None, fov: float | None) -> Camera:
    """The camera with another size and angle; pixels are square then, and the principal point is in the middle."""
    if size is None and fov is None:
        return camera
    width, height = fit(tuple[int, int], size or (camera.width, camera.height), "camera: size")
    own = math.degrees(2 * math.atan(camera.width / (2 * camera.fx)))
    wide = fit(float, own if fov is None else fov, "camera: fov")
    if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE and 0 < wide < 180):
        raise BadInput(f"camera: size {width} x {height}, fov {wide:g}: give 1 to {MAX_SIDE} pixels, 0 to 180 degrees")
    focal = width / (2 * math.tan(math.radians(wide) / 2))
    return Camera(camera.world_to_camera, focal, focal, width / 2, height / 2, width, height)


def read(path: str | Path, **options: Any) -> Dataset:
    """The data set in a folder, in any layout that `surfkit train` reads.

    Args:
        path: Folder of the data set.
        options: As on the command line, with underscores: `scale=4`, `longest=1600`, `test_every=8`, `masks=...`; see
            `surfkit.io.datasets.data.ReadSettings`.

    Raises:
        BadInput: Something is missing, damaged or not supported.
    """
    data = settings_of(ReadSettings, options, "read", "option").of(fit(Path, path, "read"))
    with heard() as texts:
        return Dataset(data, read_scene(data), tuple(texts))
