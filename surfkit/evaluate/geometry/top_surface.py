"""The surface of a cloud as seen from above, so that heights can be subtracted."""

from __future__ import annotations

import numpy as np

from surfkit.core.check import BadInput
from surfkit.evaluate.geometry.heights import MAX_CELLS, mesh_of_cells
from surfkit.evaluate.geometry.scores import surface_gap, tree
from surfkit.evaluate.geometry.surface_file import SurfaceFile

CELL_GAPS = 2.0
"""Side of a square, in those of one that a single point would have: four points lie in each, and few are empty."""


def highest(cloud: SurfaceFile) -> SurfaceFile:
    """A mesh of the highest points of a cloud, z up: one vertex in each square of four points."""
    points = np.concatenate(list(cloud.blocks()))
    plan = points[:, :2] - points[:, :2].min(0)
    few = plan[:: max(1, len(plan) // 100_000)]
    cell = CELL_GAPS * surface_gap(tree(plan), few)
    if not cell > 0:
        raise BadInput(f"{cloud.path}: its points lie on top of one another, so there is no surface in it")
    at = np.floor(plan / cell).astype(np.int64)
    width, height = at.max(0) + 1
    if width * height > MAX_CELLS:
        raise BadInput(f"{cloud.path}: {width} x {height} cells of {cell:.3g} are too many; cut the cloud to the site")
    places, (rows, columns) = np.empty((height, width, 3)), np.indices((height, width))
    places[..., 0] = (columns + 0.5) * cell + points[:, 0].min()
    places[..., 1] = (rows + 0.5) * cell + points[:, 1].min()
    heights = np.full(height * width, -np.inf)
    np.maximum.at(heights, at[:, 1] * width + at[:, 0], points[:, 2])
    places[..., 2] = np.where(np.isfinite(heights), heights, np.nan).reshape(height, width)
    return SurfaceFile(cloud.path, *mesh_of_cells(cloud.path, places, is_mirrored=False))
