"""A photograph whose rows were read one after another while the camera moved, as one that was exposed at once.

A row at the share s of the height, -1/2 to 1/2 from the first to the last, was taken from the centre of the camera
plus s d, where d is the motion during the readout. In the camera's frame, with the inverse depth 1/Z of what a pixel
with the ray (x, y, 1) shows, the middle row would have seen that along (x, y, 1) + s d/Z. That is exact, for any
depth. Pixels need the depth of everything, so a smooth surface through the sparse points stands for it: what stands out
of it by the share p of its depth is left with the share p of its shift.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

ROWS, COLUMNS = 9, 12
"""Nodes of the surface of inverse depths."""
SMOOTHNESS = 1.0
"""Weight of the bend between three nodes, beside 1 of a point."""
MIN_POINTS = 12
"""With fewer points the surface is flat and faces the camera."""
STEPS = 4
"""To find the row that saw a pixel: each leaves about a hundredth of the error of the one before."""
GRID_PX = 8
"""Where pixels come from is computed at each so many, and interpolated between: off by less than 0.01 px."""
STRIPE = 256
"""Rows that are written at once."""


@dataclass(frozen=True)
class RowMotion:
    """Motion of a camera during the readout of a photograph.

    Attributes:
        share: (3,) the motion in the camera's frame, as a share of the median depth of the photograph.
        nodes: (ROWS, COLUMNS) inverse depths times that median, over the photograph as stored.
    """

    share: tuple[float, float, float]
    nodes: tuple[tuple[float, ...], ...]

    @classmethod
    def fitted(cls, motion: np.ndarray, pixels: np.ndarray, depths: np.ndarray, size: tuple[int, int]) -> RowMotion:
        """The motion of a photograph, (3,) in the camera's frame, with a surface through points that it shows.

        Args:
            motion: Units of the model.
            pixels: (K, 2) of the points, in the file.
            depths: (K,) of the points, units of the model; more than 0.
            size: Width and height, pixels.
        """
        middle = float(np.median(depths))
        nodes = _surface(pixels / size, middle / depths)
        share = tuple(float(value) for value in np.round(motion / middle, 6))
        return cls(share, tuple(map(tuple, np.round(nodes, 4).tolist())))  # type: ignore[arg-type]

    def seen_at_once(self, pixels: np.ndarray, camera: Any) -> np.ndarray:
        """(K, 2) where the middle row would have seen what (K, 2) pixels show; `camera` is pycolmap's."""
        rays = _rays(camera, pixels)
        return np.asarray(camera.img_from_cam(rays + self._shifts(pixels, camera))).reshape(-1, 2)

    def sources(self, rays: np.ndarray, camera: Any) -> np.ndarray:
        """(K, 2) pixels that show what the middle row would have seen along (K, 2) rays x, y of depth 1."""
        pixels = np.asarray(camera.img_from_cam(_deep(rays))).reshape(-1, 2)
        for _ in range(STEPS):
            shift = self._shifts(np.nan_to_num(pixels), camera)
            own = rays * (1 + shift[:, 2:]) - shift[:, :2]
            pixels = np.asarray(camera.img_from_cam(_deep(own))).reshape(-1, 2)
        return pixels

    def straightened(self, picture: np.ndarray, camera: Any, pinhole: Any) -> np.ndarray:
        """(H, W, C) uint8 of a pinhole camera that sees all rows at once, of a photograph (h, w, C) uint8; black where
        the photograph shows nothing."""
        width, height = pinhole.width, pinhole.height
        across, down = (np.arange(-(-size // GRID_PX) + 1) * GRID_PX + 0.5 for size in (width, height))
        spots = np.stack(np.meshgrid(across, down), -1).reshape(-1, 2)
        found = self.sources(np.asarray(pinhole.cam_from_img(spots)).reshape(-1, 2), camera)
        scaled = torch.from_numpy(2 * found / (camera.width, camera.height) - 1).float()  # as grid_sample counts
        nodes = scaled.nan_to_num(nan=9.0).reshape(1, len(down), len(across), 2).permute(0, 3, 1, 2)
        source = torch.from_numpy(picture).permute(2, 0, 1)[None].float()
        made = []
        for top in range(0, len(down) - 1, STRIPE // GRID_PX):
            part = nodes[:, :, top : top + STRIPE // GRID_PX + 1]
            size = ((part.shape[2] - 1) * GRID_PX + 1, (len(across) - 1) * GRID_PX + 1)
            fine = torch.nn.functional.interpolate(part, size, mode="bilinear", align_corners=True)
            fine = fine[:, :, :-1, :width].permute(0, 2, 3, 1)
            drawn = torch.nn.functional.grid_sample(source, fine, mode="bilinear", align_corners=False)
            made.append(drawn[0].round().clamp(0, 255).to(torch.uint8).permute(1, 2, 0))
        return torch.cat(made)[:height].contiguous().numpy()

    def _shifts(self, pixels: np.ndarray, camera: Any) -> np.ndarray:
        """(K, 3) s d/Z of (K, 2) pixels."""
        at = (pixels / (camera.width, camera.height)).clip(-0.1, 1.1)
        inverse = (_weights(at.clip(0, 1)) * np.ravel(self.nodes)[_corners(at.clip(0, 1))]).sum(1)
        return (at[:, 1:] - 0.5) * inverse[:, None] * np.array(self.share)


def _deep(rays: np.ndarray) -> np.ndarray:
    return np.column_stack([rays, np.ones(len(rays))])


def _rays(camera: Any, pixels: np.ndarray) -> np.ndarray:
    return _deep(np.asarray(camera.cam_from_img(pixels)).reshape(-1, 2))


def _cells(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(K, 2) column and row of the cell of (K, 2) places, 0 to 1, and (K, 2) where in it they are."""
    spot = at * (COLUMNS - 1, ROWS - 1)
    cell = np.floor(spot).clip(0, (COLUMNS - 2, ROWS - 2)).astype(int)
    return cell, spot - cell


def _corners(at: np.ndarray) -> np.ndarray:
    """(K, 4) numbers of the nodes about (K, 2) places."""
    column, row = _cells(at)[0].T
    first = row * COLUMNS + column
    return np.stack([first, first + 1, first + COLUMNS, first + COLUMNS + 1], 1)


def _weights(at: np.ndarray) -> np.ndarray:
    """(K, 4) what each of these nodes counts."""
    x, y = _cells(at)[1].T
    return np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], 1)


def _surface(at: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(ROWS, COLUMNS) nodes of a smooth surface through (K,) values at (K, 2) places, 0 to 1; between them."""
    if len(values) < MIN_POINTS:
        return np.ones((ROWS, COLUMNS))
    at = at.clip(0, 1)
    weights, corners = _weights(at), _corners(at)
    matrix = np.zeros((ROWS * COLUMNS, ROWS * COLUMNS))
    right = np.zeros(ROWS * COLUMNS)
    for one in range(4):
        np.add.at(right, corners[:, one], weights[:, one] * values)
        for other in range(4):
            np.add.at(matrix, (corners[:, one], corners[:, other]), weights[:, one] * weights[:, other])
    numbers = np.arange(ROWS * COLUMNS).reshape(ROWS, COLUMNS)
    for line in (*numbers, *numbers.T):
        for three in zip(line, line[1:], line[2:], strict=False):
            bend = np.zeros(ROWS * COLUMNS)
            bend[list(three)] = 1, -2, 1
            matrix += SMOOTHNESS * np.outer(bend, bend)
    matrix[np.diag_indices(ROWS * COLUMNS)] += 1e-9
    return np.linalg.solve(matrix, right).clip(values.min(), values.max()).reshape(ROWS, COLUMNS)
