"""A data set in Python."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from surfkit.api.listen import heard
from surfkit.core.check import BadInput
from surfkit.core.fit import fit, settings_of
from surfkit.io.datasets.data import Data, ReadSettings
from surfkit.io.datasets.read import read as read_scene
from surfkit.scene.camera import Camera
from surfkit.scene.scene import Frame, Scene, View


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
    ) -> Camera:
        """A camera that stands somewhere and looks at something.

        Args:
            position: (3,) frame of the input.
            target: (3,) frame of the input; it comes to the principal point.
            up: (3,) direction that is up in the picture.
            like: The view whose lens and size it has; by default the first one.

        Raises:
            BadInput: The three do not give a direction.
        """
        lens = (like or self.train[0]).camera
        eye, at = (self.frame.to_local(np.array([place], np.float64))[0] for place in (position, target))
        forward = np.asarray(at, np.float64) - eye
        right = np.cross(forward, np.asarray(up, np.float64))
        if not (np.linalg.norm(forward) > 0 and np.linalg.norm(right) > 1e-9 * np.linalg.norm(forward)):
            raise BadInput(f"camera: {position} looks at {target} along the direction that is up; give another `up`")
        forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = right, np.cross(forward, right), forward
        pose[:3, 3] = -pose[:3, :3] @ eye
        return replace(lens, world_to_camera=torch.from_numpy(pose))


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
