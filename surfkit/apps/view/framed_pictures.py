"""Pictures of a training as they lie on its page, and the places that their pixels show."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from surfkit.scene.camera import Camera

BESIDE_GREY = 128
"""Beside pictures that are not as wide as the window."""


@dataclass(frozen=True)
class FramedPictures:
    """Pictures of one camera side by side, in the middle of a window.

    Attributes:
        camera: Of all of them.
        depth: (H, W) z of the surface, local units; not above 0 where there is none.
        count: Of the pictures.
        window: Height and width, in their pixels.
    """

    camera: Camera
    depth: np.ndarray
    count: int
    window: tuple[int, int]

    def place(self, across: float, down: float) -> np.ndarray | None:
        """(3,) local place that a pixel shows; None in the sky and beside the pictures.

        Args:
            across: From the left of the window, in widths of it.
            down: From its top, in heights of it.
        """
        height, width = self.depth.shape
        top, left = margins((height, self.count * width), self.window)
        row, column = math.floor(down * self.window[0]) - top, math.floor(across * self.window[1]) - left
        if not (0 <= row < height and 0 <= column < self.count * width):
            return None
        column %= width
        depth = float(self.depth[row, column])
        if not depth > 0:
            return None
        camera, pose = self.camera, self.camera.world_to_camera.numpy()
        ray = np.array([(column + 0.5 - camera.cx) / camera.fx, (row + 0.5 - camera.cy) / camera.fy, 1.0])
        return pose[:3, :3].T @ (depth * ray - pose[:3, 3])


def window_of(shape: tuple[int, int], aspect: float) -> tuple[int, int]:
    """The least height and width, with a ratio of width to height of `aspect`, that hold a picture."""
    height, width = shape
    return max(height, round(width / aspect)), max(width, round(height * aspect))


def margins(shape: tuple[int, int], window: tuple[int, int]) -> tuple[int, int]:
    """Pixels above a picture in the middle of a window, and at its left."""
    return (window[0] - shape[0]) // 2, (window[1] - shape[1]) // 2


def framed(images: list[np.ndarray], window: tuple[int, int]) -> np.ndarray:
    """(*window, 3) uint8: pictures of one height side by side, with grey about them."""
    row = np.concatenate(images, axis=1)
    (height, width), whole = row.shape[:2], np.full((*window, 3), BESIDE_GREY, np.uint8)
    top, left = margins((height, width), window)
    whole[top : top + height, left : left + width] = row
    return whole
