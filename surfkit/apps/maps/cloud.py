"""A cloud of points, spread evenly over a mesh, as a Cloud Optimized Point Cloud: LAZ 1.4 in an octree."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from surfkit.apps.maps.bins import BATCH_TRIANGLES
from surfkit.apps.maps.copc import POINT_SOURCE_ID, Octree, write_copc
from surfkit.apps.maps.geotiff import GeoTiffSettings
from surfkit.apps.maps.sorted_points import POINT, SortedPoints
from surfkit.apps.maps.surface_model import COLOR_CHANNELS, has_colors
from surfkit.core.check import BadInput
from surfkit.core.events import Progress, emit
from surfkit.core.optional import needed
from surfkit.core.version import own_version
from surfkit.evaluate.geometry.sampling import R2_STEPS
from surfkit.evaluate.geometry.surface_file import SurfaceFile

BATCH_POINTS = 1 << 20
"""Points in memory."""
STEPS_PER_SPACING = 1000
"""Steps of a coordinate within the distance of points."""


Classify = Callable[[np.ndarray], np.ndarray]
"""(n,) uint8 classes of the LAS specification, of (n, 3) easting, northing and height."""


def write_cloud(
    surface: SurfaceFile, sheet: GeoTiffSettings, name: str, spacing: float, classify: Classify | None = None
) -> dict[str, int]:
    """Write points on a mesh, one for each square of so long a side, and return how many there are of each class.

    Point format 7: coordinates, and colours of 16 bits where the mesh has some; the coordinate reference system as
    well-known text.

    Args:
        surface: The mesh.
        sheet: Where; points outside of its cells and its area are left out.
        name: File name.
        spacing: Side of a square, units of the input.
        classify: Tells the classes of points; None leaves them at 0, never classified.

    Raises:
        BadInput: A package is missing, or coordinates span more than the format holds.
    """
    with needed("laspy", "a point cloud in LAZ"):
        import laspy
        from laspy.vlrs.known import WktCoordinateSystemVlr
    with needed("lazrs", "a point cloud in LAZ"):
        import lazrs  # noqa: F401 (what laspy compresses with)
    step = 10.0 ** math.floor(math.log10(spacing) - math.log10(STEPS_PER_SPACING) + 0.5)
    low, high = _bounds(surface, sheet)
    if max(high - low) / 2 / step >= 2**31 - 1:
        raise BadInput(f"--spacing {spacing:g}: too fine for a LAZ file of this width; give a larger one")
    header = laspy.LasHeader(version="1.4", point_format=7 if has_colors(surface) else 6)
    header.generating_software = f"surfkit {own_version()}"
    header.file_source_id = POINT_SOURCE_ID
    header.scales, header.offsets = np.full(3, step), np.round((low + high) / 2)
    header.vlrs.append(WktCoordinateSystemVlr(sheet.crs.to_wkt(version="WKT1_GDAL")))
    header.global_encoding.wkt = True
    least, most = np.floor((low - header.offsets) / step), np.ceil((high - header.offsets) / step)
    octree = Octree.around(least.astype(np.int64), most.astype(np.int64), spacing / step)
    path, counts = sheet.folder / name, np.zeros(256, np.int64)
    spill = path.with_suffix(".points")
    points = SortedPoints(spill, octree.low, octree.side)
    for places, colors in sample_evenly(surface, spacing**2):
        places = sheet.grid.to_map(places)
        east, north = places[:, 0], places[:, 1]
        inside = (east >= low[0]) & (east <= high[0]) & (north >= low[1]) & (north <= high[1])
        if sheet.grid.area is not None:
            inside = inside & sheet.grid.area.contains(places[:, :2])
        some = np.zeros(int(inside.sum()), POINT)
        some["place"] = np.rint((places[inside] - header.offsets) / step)
        if colors is not None:
            some["color"] = colors[inside]
        if classify is not None:
            some["kind"] = classify(places[inside])
        points.add(some)
        counts += np.bincount(some["kind"], minlength=256)
    with path.open("w+b") as file:
        write_copc(file, header, octree, points)
    spill.unlink()
    sheet.deliver(path)
    return {str(number): int(counts[number]) for number in np.flatnonzero(counts)}


def _bounds(surface: SurfaceFile, sheet: GeoTiffSettings) -> tuple[np.ndarray, np.ndarray]:
    """(3,) corners of the box around the part of a mesh that lies on the map, in coordinates of the map."""
    west, south, east, north = sheet.grid.bounds
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for block in surface.blocks():
        if len(block):
            places = sheet.grid.to_map(block)
            low, high = np.minimum(low, places.min(0)), np.maximum(high, places.max(0))
    return np.maximum(low, [west, south, -np.inf]), np.minimum(high, [east, north, np.inf])


def sample_evenly(surface: SurfaceFile, area: float) -> Iterator[tuple[np.ndarray, np.ndarray | None]]:
    """Points of a mesh, one for each so large part of its area, in the order of its triangles: (n, 3) float64
    positions, and (n, 3) uint8 colours where the mesh has some.

    A point lies wherever the area so far passes another multiple of `area`; within a triangle the points follow a
    low-discrepancy sequence. So there are the same points however many are made at once.
    """
    colored, so_far, number = has_colors(surface), 0.0, 0
    total = len(surface.triangles)
    for start in range(0, total, BATCH_TRIANGLES):
        faces = np.asarray(surface.triangles[start : start + BATCH_TRIANGLES])
        corners = surface.vertices(faces.ravel()).reshape(-1, 3, 3)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        ends = so_far + np.cumsum(np.linalg.norm(normals, axis=1) / 2)
        so_far = float(ends[-1])
        last = max(number, math.ceil(so_far / area - 0.5))
        while number < last:
            order = np.arange(number, min(last, number + BATCH_POINTS))
            number += len(order)
            owner = np.searchsorted(ends, (order + 0.5) * area, "right").clip(max=len(ends) - 1)
            turns = order * R2_STEPS[0], order * R2_STEPS[1]
            u, v = (turn - np.floor(turn) for turn in turns)
            beyond = u + v > 1
            u, v = np.where(beyond, 1 - u, u), np.where(beyond, 1 - v, v)
            shares = (1 - (u + v))[:, None], u[:, None], v[:, None]
            places = _mixed(shares, [corners[owner, corner] for corner in range(3)])
            colors = None
            if colored:
                owned = faces[owner]
                rows = [surface.rows[owned[:, corner]] for corner in range(3)]
                values = [np.stack([row[name] for name in COLOR_CHANNELS], axis=1) for row in rows]
                colors = np.rint(_mixed(shares, values)).astype(np.uint8)
            yield places, colors
        emit(Progress("sampling points", min(start + BATCH_TRIANGLES, total), total))


def _mixed(shares: Sequence[np.ndarray], values: Sequence[np.ndarray]) -> np.ndarray:
    """(n, 3) sum of (n, 3) values at the three corners by their (n, 1) shares; three times as fast as a sum over an
    axis of three."""
    return shares[0] * values[0] + shares[1] * values[1] + shares[2] * values[2]
