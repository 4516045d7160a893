"""Splats, meshes and points as a browser draws them: chosen within a budget, and coloured."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from surfkit.compress.levels.lod_tree import LodTree
from surfkit.evaluate.images.comparison_pictures import RAMP
from surfkit.io.splats.splat_table import SplatTable
from surfkit.mesh.base import Mesh
from surfkit.primitives.init import SH_C0
from surfkit.scene.rotations import numpy_rotations

Colors = Literal["as trained", "height", "normal", "block"]
PALETTE = np.array(
    [[31, 119, 180], [255, 127, 14], [44, 160, 44], [214, 39, 40], [148, 103, 189], [140, 86, 75], [227, 119, 194]],
    np.uint8,
)
"""Of blocks, one after the other."""
COVARIANCE_UNIT, MAX_COVARIANCE_SCALE = 10.0, 255.0
"""The unit of covariances, in typical standard deviations of splats; and the largest one in it, whose square is the
largest number of 16 bits."""
HEIGHT_PERCENTILES = (2, 98)
"""Percentiles of the heights at the ends of the colours."""


@dataclass(frozen=True)
class BrowserSplats:
    """Splats for a browser.

    Attributes:
        means: (N, 3) float32 local positions.
        covariances: (N, 3, 3) float32, in units of `unit` squared.
        rgb: (N, 3) uint8.
        opacities: (N,) float32.
        unit: Local units: browsers keep covariances in 16 bits, and in this unit they lie in the middle of these.
    """

    means: np.ndarray
    covariances: np.ndarray
    rgb: np.ndarray
    opacities: np.ndarray
    unit: float

    def placed(self, places: np.ndarray, count: int) -> BrowserSplats:
        """The same splats at (N,) places in a list of `count`, whose other places hold splats that are not seen."""

        def spread(values: np.ndarray) -> np.ndarray:
            found = np.zeros((count, *values.shape[1:]), values.dtype)
            found[places] = values
            return found

        parts = spread(self.means), spread(self.covariances), spread(self.rgb), spread(self.opacities)
        return BrowserSplats(*parts, self.unit)


def level_within(levels: LodTree, budget: int) -> int | None:
    """The finest level of detail with at most `budget` splats; None if all have more."""
    return next((number for number, level in enumerate(levels.levels) if len(level) <= budget), None)


def unit_of(table: SplatTable) -> float:
    """The unit of covariances of a model, local units."""
    return COVARIANCE_UNIT * max(table.median_scale(), 1e-12)


def drawn(table: SplatTable, rgb: np.ndarray | None = None, unit: float | None = None) -> BrowserSplats:
    """What a browser needs of splats of a local frame.

    Args:
        table: The splats.
        rgb: (N, 3) uint8 colours; those of degree 0 where none are given.
        unit: Of covariances, if not that of these splats.
    """
    unit = unit_of(table) if unit is None else unit
    scales = table.ellipsoid_log_scales().float().exp()
    axes = axes_of(table.quats) * (scales / unit).clamp_max(MAX_COVARIANCE_SCALE)[:, None, :]
    colors = (0.5 + SH_C0 * table.sh0.float()).clamp(0, 1).mul(255).round().byte().numpy() if rgb is None else rgb
    return BrowserSplats(
        table.means.float().numpy(),
        (axes @ axes.transpose(1, 2)).numpy(),
        colors,
        table.opacity_logits.float().sigmoid().numpy(),
        unit,
    )


def axes_of(quats: Tensor) -> Tensor:
    """(N, 3, 3) rotation matrices of (N, 4) quaternions of any length: columns are the axes of a splat."""
    return torch.from_numpy(numpy_rotations(quats.numpy())).float()


def normals_of(table: SplatTable, up: np.ndarray) -> np.ndarray:
    """(N, 3) float32 unit vectors across the splats, of both that one which points upwards."""
    axes = axes_of(table.quats)
    thinnest = table.ellipsoid_log_scales().argmin(1)
    found = axes[torch.arange(len(axes)), :, thinnest].numpy()
    return np.where((found @ up < 0)[:, None], -found, found)


def by_normal(normals: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """(N, 3) uint8: red east, green north, blue up; `axes` are these directions in rows."""
    return np.round((normals @ axes.T + 1) * 127.5).astype(np.uint8)


def by_height(heights: np.ndarray, bounds: tuple[float, float]) -> np.ndarray:
    """(N, 3) uint8 of heights, from dark to pale."""
    share = np.clip((heights - bounds[0]) / max(bounds[1] - bounds[0], 1e-12), 0, 1)
    steps = np.linspace(0, 1, len(RAMP))
    return np.stack([np.round(np.interp(share, steps, RAMP[:, i]) * 255) for i in range(3)], axis=1).astype(np.uint8)


def height_bounds(heights: np.ndarray) -> tuple[float, float]:
    """Of the ends of the colours."""
    low, high = np.percentile(heights, HEIGHT_PERCENTILES)
    return float(low), float(high)


def by_block(owner: np.ndarray) -> np.ndarray:
    """(N, 3) uint8 by (N,) number of the block; grey for none."""
    return np.where((owner >= 0)[:, None], PALETTE[owner % len(PALETTE)], np.uint8(128))


def fewer_faces(mesh: Mesh, budget: int) -> Mesh:
    """The mesh with at most `budget` triangles: vertices in a cell of a grid become one, in their middle.

    Rossignac and Borrel, "Multi-resolution 3D approximations for rendering complex scenes", 1993. The cells are as
    small as the budget allows.
    """
    if len(mesh.faces) <= budget:
        return mesh
    low = mesh.vertices.min(0).astype(np.float64)
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    area = 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum(dtype=np.float64))
    side = max(np.sqrt(2 * area / max(budget, 1)), 1e-9)  # a flat cell has two triangles
    while len((found := _clustered(mesh, low, side)).faces) > budget:
        side *= max(1.05, np.sqrt(len(found.faces) / max(budget, 1)))
    return found


def _clustered(mesh: Mesh, low: np.ndarray, side: float) -> Mesh:
    cells = ((mesh.vertices - low) / side).astype(np.int64)
    _, north, up = cells.max(0) + 1
    key = (cells[:, 0] * north + cells[:, 1]) * up + cells[:, 2]
    _, cell, count = np.unique(key, return_inverse=True, return_counts=True)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(cell, column, len(count)) / count for column in values.T], axis=1)

    faces = cell[mesh.faces].astype(np.int32)
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    colors = None if mesh.colors is None else np.round(mean(mesh.colors)).astype(np.uint8)
    values = {name: mean(each[:, None])[:, 0].astype(np.float32) for name, each in mesh.values.items()}
    return Mesh(mean(mesh.vertices).astype(np.float32), faces[np.sort(first)], colors, values=values)


def some(count: int, budget: int) -> np.ndarray:
    """Rows of at most `budget` of `count` points, evenly spread over their order."""
    return np.linspace(0, count - 1, min(count, budget)).round().astype(np.int64) if count else np.zeros(0, np.int64)
