"""The polygons of a file within which a reconstruction is compared with the truth."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from surfkit.evaluate.geometry.repetition import Box
from surfkit.evaluate.geometry.surface_file import SurfaceFile, system_of
from surfkit.evaluate.geometry.transform import apply, scale_of, seen_from
from surfkit.io.area import Area, read_area
from surfkit.io.polygon_file import Site
from surfkit.scene.crop import Axis
from surfkit.scene.scene import Frame, View
from surfkit.scene.up_direction import map_axes, up_direction


def compared_area(
    path: Path,
    sides: tuple[SurfaceFile, SurfaceFile],
    axis: Axis | None,
    views: Sequence[View],
    frame: Frame | None,
    matrix: np.ndarray,
) -> tuple[Area, Box]:
    """The area of a file, for positions in the frame of the truth, and a box about all that may lie in it.

    Its polygons are transformed to the system of the photographs; without any, to that which the reconstruction names,
    or the truth where it lies in the same frame.

    Args:
        path: The file.
        sides: The reconstruction and the truth.
        axis: Of the frame of the truth that points up; None to find out.
        views: Training views, perhaps none.
        frame: Of the views.
        matrix: (4, 4) from the frame of the reconstruction to that of the truth.

    Raises:
        BadInput: No such polygons, or they lie beside the reconstruction.
    """
    ours, theirs = sides
    crs = None if frame is None else frame.crs
    if frame is None:
        crs = system_of(ours.path) or (system_of(theirs.path) if np.array_equal(matrix, np.eye(4)) else None)
    up = up_direction(axis, views, frame, matrix).direction @ matrix[:3, :3] / scale_of(matrix)
    axes, there = np.eye(4), np.linalg.inv(matrix)
    axes[:3, :3] = map_axes(up)
    low, high = extent(apply(axes, block) for block in ours.blocks())
    found = read_area(path, Site("the reconstruction", crs, (*low[:2], *high[:2])), axes[:3, :3])
    least, most = extent(apply(axes @ there, block) for block in theirs.blocks())
    west, south, east, north = found.bounds
    box = np.array([west, south, min(low[2], least[2])]), np.array([east, north, max(high[2], most[2])])
    return found.moved(matrix), seen_from(matrix @ axes.T, box)


def extent(blocks: Iterable[np.ndarray]) -> Box:
    """Least and greatest coordinates of blocks of (n, 3) positions."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for block in blocks:
        low, high = np.minimum(low, block.min(0, initial=np.inf)), np.maximum(high, block.max(0, initial=-np.inf))
    return low, high
