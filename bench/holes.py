"""Holes of a run where photographs see enough: in its maps, in its contour lines and in its mesh.

    surfkit maps RUN --products orthophoto contours
    python bench/holes.py RUN [MAPS] [RESULT.json]

MAPS is RUN/maps if it is left out. A cell of the maps counts if three and more training views have it in their picture,
at its height; that something may hide it is not looked at, so streets between high houses count as seen where they are
not. The height of a hole is interpolated between the cells around it. Only cells within the outline count: the covered
area, closed by 25 cells, so that wider gaps are no holes but places beside the map.

Printed, and written as JSON: the share of these cells without a height, and without a colour; pieces of contour lines,
in the file, which cuts them at tiles, and in one piece of the map (a surface without holes and steps has closed lines
and few pieces); edges of mesh.ply with one triangle whose middle three views have in their picture, and which lie more
than 25 cells within the outline, as a share of all edges. Frames are those of the maps, whatever is up.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import torch
from scipy import ndimage
from scipy.interpolate import LinearNDInterpolator, NearestNDInterpolator

from surfkit.apps.maps.contours import contour_lines, even_interval
from surfkit.apps.maps.map_grid import MapGrid, Window
from surfkit.apps.maps.owned_files import MAPS_RECORD
from surfkit.core.check import BadInput
from surfkit.core.codec import read_json
from surfkit.evaluate.geometry.surface_file import read_surface
from surfkit.evaluate.mesh.edges import boundary_edges
from surfkit.evaluate.mesh.whole import whole_mesh
from surfkit.runs.pipeline import opened
from surfkit.runs.resume import read_unchanged
from surfkit.scene.scene import Frame, View

ENOUGH = 3
"""Training views that must have a place in their picture."""
CLOSED = 25
"""Cells by which the covered area is closed, and further than which within it an edge is not one of the rim."""
POINTS = 1 << 20
"""That are projected at once."""


def read_grid(maps: Path) -> MapGrid:
    """The cells of maps that surfkit drew.

    Raises:
        BadInput: There are none.
    """
    record = read_json(maps / MAPS_RECORD, dict[str, Any])
    gsd, (west, _, _, north), size = record["gsd"], record["bounds"], record["size"]
    return MapGrid(np.array(record["axes"]), gsd, round(west / gsd), round(north / gsd), *size)


def outline_of(covered: np.ndarray, radius: int = CLOSED) -> np.ndarray:
    """(H, W) bool, the covered cells closed by a disc: every place that no disc outside of them reaches into."""
    wide = np.pad(covered, radius + 1)
    grown = ndimage.distance_transform_edt(~wide) <= radius
    closed = ndimage.distance_transform_edt(grown) > radius
    return (closed | wide)[radius + 1 : -radius - 1, radius + 1 : -radius - 1]


def filled(heights: np.ndarray, where: np.ndarray) -> np.ndarray:
    """(H, W) heights, those of holes linear between the cells around them (a triangulation of their rims).

    Args:
        heights: NaN in holes.
        where: (H, W) bool, the cells that are wanted.
    """
    known = np.isfinite(heights)
    rim = known & ndimage.binary_dilation(~known & where, np.ones((3, 3), bool))
    holes = np.argwhere(~known & where)
    found = heights.copy()
    if not len(holes):
        return found
    places, values = np.argwhere(rim), heights[rim]
    nearest = NearestNDInterpolator(places, values)(holes)
    is_flat = len(places) < 3 or np.linalg.matrix_rank(places - places[0]) < 2
    between = np.full(len(holes), np.nan) if is_flat else LinearNDInterpolator(places, values)(holes)
    found[tuple(holes.T)] = np.where(np.isfinite(between), between, nearest)
    return found


def times_seen(points: np.ndarray, views: Sequence[View], frame: Frame) -> np.ndarray:
    """(n,) int32, how many views have (n, 3) points of the input frame in their picture; nothing hides any."""
    found = np.zeros(len(points), np.int32)
    for start in range(0, len(points), POINTS):
        part = torch.from_numpy(frame.to_local(points[start : start + POINTS]))
        for view in views:
            x, y, z = view.camera.project(part).numpy().T
            found[start : start + POINTS] += (
                (z > 0) & (x >= 0) & (x < view.camera.width) & (y >= 0) & (y < view.camera.height)
            )
    return found


def cell_places(grid: MapGrid, heights: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """(n, 3) float64 centres, in the frame of the input, of (n, 2) rows and columns of a map with its heights."""
    row, column = cells.T
    east, north = (grid.west + column + 0.5) * grid.gsd, (grid.north - row - 0.5) * grid.gsd
    return np.stack([east, north, heights[row, column]], axis=1) @ grid.turn


def map_holes(
    heights: np.ndarray, colored: np.ndarray, grid: MapGrid, views: Sequence[View], frame: Frame
) -> tuple[dict[str, Any], np.ndarray]:
    """Figures of the maps, and (H, W) bool of their outline.

    Args:
        heights: (H, W), NaN where there is none.
        colored: (H, W) bool of the orthophoto.
        grid: Of both.
        views: Training views.
        frame: Of the views.
    """
    outline = outline_of(np.isfinite(heights))
    cells = np.argwhere(outline)
    seen = times_seen(cell_places(grid, filled(heights, outline), cells), views, frame) >= ENOUGH
    row, column = cells[seen].T
    without = {"height": ~np.isfinite(heights[row, column]), "color": ~colored[row, column]}
    shares = {f"without_{name}": float(found.mean()) if len(found) else None for name, found in without.items()}
    return {"cells": len(cells), "seen": len(row), "cell": grid.gsd, **shares}, outline


def mesh_holes(path: Path, grid: MapGrid, outline: np.ndarray, views: Sequence[View], frame: Frame) -> dict[str, Any]:
    """Figures of the edges of a mesh that have one triangle."""
    surface = read_surface(path)
    mesh = whole_mesh(surface)
    edges, all_edges = boundary_edges(mesh)
    middles = mesh.places[edges].mean(1, dtype=np.float64) + surface.offset
    column, row, _ = np.floor(grid.to_cells(middles)).astype(np.int64).T
    inside = (row >= 0) & (row < grid.height) & (column >= 0) & (column < grid.width)
    depth = ndimage.distance_transform_edt(np.pad(outline, 1))[1:-1, 1:-1]
    inside[inside] = depth[row[inside], column[inside]] > CLOSED
    inside[inside] = times_seen(middles[inside], views, frame) >= ENOUGH
    count = int(inside.sum())
    return {"edges": all_edges, "boundary": len(edges), "away_from_rim": count, "share": count / all_edges}


def contour_pieces(heights: np.ndarray, grid: MapGrid, maps: Path) -> dict[str, Any]:
    """Pieces of contour lines of the whole map, and in the file, if there is one."""
    record = read_json(maps / MAPS_RECORD, dict[str, Any]).get("contours")
    known = heights[np.isfinite(heights)]
    interval = record["interval"] if record else even_interval(known.min(), known.max())
    lines = contour_lines(heights, grid, Window(0, 0, grid.width, grid.height), interval)
    closed = sum(bool((line[0] == line[-1]).all()) for _, line in lines)
    return {"interval": interval, "pieces": len(lines), "closed": closed, "in_file": record and record["lines"]}


def measure(folder: Path, maps: Path) -> dict[str, Any]:
    """All figures of a run and its maps.

    Raises:
        BadInput: It is no run, has no mesh, or there are no maps of it.
    """
    run = opened(folder)
    for path in (run.mesh, maps / "dsm.tif", maps / "orthophoto.tif"):
        if not path.is_file():
            raise BadInput(f"{path}: no such file; surfkit mesh makes the mesh, and surfkit maps the maps")
    scene, grid = read_unchanged(run), read_grid(maps)
    with rasterio.open(maps / "dsm.tif") as file:
        heights = file.read(1, masked=True).astype(np.float64).filled(np.nan)
    with rasterio.open(maps / "orthophoto.tif") as file:
        colored = file.read(file.count) > 0
    if heights.shape != (grid.height, grid.width) or colored.shape != heights.shape:
        raise BadInput(f"{maps}: its files are not of one map: give surfkit maps again")
    found, outline = map_holes(heights, colored, grid, scene.train, scene.frame)
    return {
        "views": len(scene.train),
        "maps": found,
        "contours": contour_pieces(heights, grid, maps),
        "mesh": mesh_holes(run.mesh, grid, outline, scene.train, scene.frame),
    }


def lines_of(found: dict[str, Any]) -> list[str]:
    """The figures for people."""
    maps, contours, mesh = found["maps"], found["contours"], found["mesh"]
    shares = ["-" if maps[name] is None else f"{maps[name]:.3%}" for name in ("without_height", "without_color")]
    in_file = "" if contours["in_file"] is None else f", {contours['in_file']:,} in the file, cut at tiles"
    return [
        f"cells of {maps['cell']:.3g} within the outline: {maps['cells']:,}; seen by {ENOUGH}+: {maps['seen']:,}",
        f"of these, without a height: {shares[0]}, without a colour: {shares[1]}",
        f"contour lines every {contours['interval']:g}: {contours['pieces']:,} pieces, {contours['closed']:,} closed"
        f"{in_file}",
        f"edges with one triangle: {mesh['boundary']:,} of {mesh['edges']:,}; seen by {ENOUGH}+ and away from the rim: "
        f"{mesh['away_from_rim']:,}, {mesh['share']:.3%} of all",
    ]


if __name__ == "__main__":
    words = sys.argv[1:]
    results = [Path(word) for word in words if word.endswith(".json")]
    folder, *others = (Path(word) for word in words if not word.endswith(".json"))
    figures = measure(folder, others[0] if others else folder / "maps")
    print("\n".join(lines_of(figures)))
    for path in results:
        path.write_text(json.dumps(figures, indent=2) + "\n")
