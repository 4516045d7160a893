"""The terrain model of maps against the exact terrain of a rendered city, and the classes of its points.

    surfkit maps RUN --products points terrain --metres-per-unit 1 --gsd 0.25 --bounds -120 -120 120 120 --out MAPS
    python bench/terrain.py TRUTH.ply [MAPS]

Maps are drawn of the exact mesh, and of its heights smoothed and with noise; maps of a run may be given too. TRUTH.ply
is the exact mesh (shibuya-synth: gt/mesh.ply, from -120 to 120 m). Its ground is the triangles with corners on a
lattice of 4 m; it goes on beneath buildings. Ground is seen where it is the highest surface of the exact mesh. Counted
are cells within 20 m of one that is; from these, those on ground that is seen, and those below something. Also counted:
classes of the points of the cloud that lie on ground that is seen, and of those 2 m and more above ground.
Results go to bench/results/terrain.json. The map is level, z up.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import rasterio
from holes import read_grid
from machine import save
from scipy import ndimage

from surfkit.apps.maps.make_maps import make_maps
from surfkit.apps.maps.map_grid import MapGrid, Window
from surfkit.apps.maps.map_settings import MapSettings
from surfkit.apps.maps.zbuffer import ZBuffer
from surfkit.apps.texture.texture_mesh import MeshWithPhotos
from surfkit.evaluate.geometry.surface_file import SurfaceFile, read_surface
from surfkit.scene.scene import Frame

LATTICE = 4.0
"""Metres between the corners of the exact ground."""
SEEN_WITHIN = 20.0
"""Metres to ground that is seen."""
MAP_SIDE = 240.0
"""Metres of the map, about 0 0."""
HIGH = 2.0
"""Metres above ground of what is an object."""


def exact(truth: Path, grid: MapGrid) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) heights of the exact ground, and of the exact surface; NaN where there are none."""
    mesh = read_surface(truth)
    corners = mesh.vertices(np.asarray(mesh.triangles[:]).ravel()).reshape(-1, 3, 3)
    plan = corners[:, :, :2]
    ground = (np.abs(plan / LATTICE - np.rint(plan / LATTICE)) < 1e-4).all((1, 2))
    ground &= (np.abs(np.ptp(plan, axis=1) - LATTICE) < 1e-3).all(1)
    found = []
    for some in (corners[ground], corners):
        buffer = ZBuffer(Window(0, 0, grid.width, grid.height))
        buffer.draw(grid.to_cells(some), np.arange(len(some)))
        found.append(np.where(buffer.covered, buffer.height, np.nan))
    return found[0], found[1]


def read_heights(path: Path) -> np.ndarray:
    """(H, W) values; NaN where there are none."""
    with rasterio.open(path) as file:
        return file.read(1, masked=True).astype(np.float64).filled(np.nan)


def rms(values: np.ndarray) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def measured(maps: Path, truth: Path) -> dict[str, float]:
    """The figures."""
    grid = read_grid(maps)
    ground, surface = exact(truth, grid)
    seen = np.isfinite(ground) & (surface - ground < 0.02)
    near = np.isfinite(ground) & (ndimage.distance_transform_edt(~seen) * grid.gsd <= SEEN_WITHIN)
    terrain, model = read_heights(maps / "dtm.tif"), read_heights(maps / "dsm.tif")
    error, before = terrain - ground, model - ground
    there, figures = near & np.isfinite(terrain), dict[str, float]()
    for name, where in (("all", there), ("ground that is seen", there & seen), ("below something", there & ~seen)):
        figures |= {
            f"{name}: RMS, m": rms(error[where]),
            f"{name}: median, m": float(np.median(error[where])),
            f"{name}: 95 % under, m": float(np.percentile(np.abs(error[where]), 95)),
        }
    figures["surface model on ground that is seen: RMS, m"] = rms(before[seen & np.isfinite(model)])
    figures["without terrain"] = float((near & ~there).sum() / near.sum())
    figures["cells"] = int(near.sum())
    if (maps / "points.copc.laz").exists():
        figures |= classes(maps / "points.copc.laz", grid, ground, surface, seen)
    return figures


def classes(path: Path, grid: MapGrid, ground: np.ndarray, surface: np.ndarray, seen: np.ndarray) -> dict[str, float]:
    """Shares of classes among points over ground that is seen, and over high objects."""
    points = laspy.read(path)
    column, row, height = grid.to_cells(np.stack([points.x, points.y, points.z], 1)).T
    at = row.astype(int).clip(0, grid.height - 1), column.astype(int).clip(0, grid.width - 1)
    kinds, above = np.asarray(points.classification), height - ground[at]
    inner = ndimage.binary_erosion(seen, iterations=max(1, round(1 / grid.gsd)))[at]
    low, high = inner & (np.abs(above) < 0.5), (surface - ground)[at] > HIGH
    high &= above > HIGH
    return {
        "points on ground that is seen: class 2": float((kinds[low] == 2).mean()),
        "points 2 m and more above ground: class 2": float((kinds[high] == 2).mean()),
        "points 2 m and more above ground: class 6": float((kinds[high] == 6).mean()),
        "points 2 m and more above ground: class 5": float((kinds[high] == 5).mean()),
    }


def meshes(truth: Path) -> Iterator[tuple[str, SurfaceFile]]:
    """The exact mesh, and a mesh of its heights every 0.5 m, smoothed by 0.5 m, with noise of 0.15 m."""
    yield "exact mesh", read_surface(truth)
    half = MAP_SIDE / 2
    grid = MapGrid.around(np.eye(3), 0.5, (-half, -half, half, half))
    _, surface = exact(truth, grid)
    noise = ndimage.gaussian_filter(np.random.default_rng(0).normal(size=surface.shape), 1.0)
    known = np.where(np.isfinite(surface), surface, np.nanmean(surface))
    heights = ndimage.gaussian_filter(known, 1.0) + noise * 0.15 / noise.std()
    row, column = np.indices(heights.shape) + 0.5
    rows = np.zeros(heights.size, [(axis, "<f8") for axis in "xyz"])
    rows["x"], rows["y"] = ((grid.west + column) / 2).ravel(), ((grid.north - row) / 2).ravel()
    rows["z"] = heights.ravel()
    number = np.arange(heights.size).reshape(heights.shape)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.concatenate([np.stack(each, -1).reshape(-1, 3) for each in ((a, b, c), (a, c, d))])
    yield "smoothed, with noise", SurfaceFile(truth, rows, faces)


def main(truth: Path, maps: Path | None = None) -> None:
    """Print the figures and keep them."""
    half, figures = MAP_SIDE / 2, dict[str, Any]()
    settings = MapSettings(("points", "terrain"), 0.25, (-half, -half, half, half), spacing=0.5, up="z")
    with tempfile.TemporaryDirectory() as folder:
        for name, mesh in meshes(truth):
            out = Path(folder) / name.split()[0]
            make_maps(MeshWithPhotos(mesh, Frame(np.zeros(3), 0.01, 1.0, None)), settings, out)
            figures |= {f"{name}: {key}": value for key, value in measured(out, truth).items()}
    if maps is not None:
        figures |= {f"maps given: {key}": value for key, value in measured(maps, truth).items()}
    for key, value in figures.items():
        print(f"{key}: {value:.4g}")
    save("terrain", figures)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
