"""The point cloud of `surfkit maps` against the same points as plain LAZ, in the order of the mesh: time, memory, size.

    python bench/copc.py [--points 5 20] [--keep]

Millions of points of a hilly mesh of 2 million triangles with colours, each cloud in a process of its own.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from machine import save

SIDE = 1000.0
"""Of the mesh, metres."""


def mesh(count: int = 1000):
    """A grid of hills with count x count vertices, as `read_surface` gives it."""
    from surfkit.evaluate.geometry.surface_file import SurfaceFile

    rows = np.zeros(
        count * count, [(axis, "<f8") for axis in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
    )
    x, y = np.meshgrid(*[np.linspace(0, SIDE, count)] * 2, indexing="ij")
    rows["x"], rows["y"] = x.ravel(), y.ravel()
    rows["z"] = (
        30 * np.sin(rows["x"] / 90) + 20 * np.cos(rows["y"] / 70) + np.random.default_rng(0).normal(0, 0.05, len(rows))
    )
    for name, wave in (("red", 11), ("green", 17), ("blue", 23)):
        rows[name] = 128 + 100 * np.sin(rows["x"] / wave) * np.cos(rows["y"] / wave)
    number = np.arange(count * count, dtype=np.int32).reshape(count, count)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.concatenate([np.stack(each, -1).reshape(-1, 3) for each in ((a, b, c), (a, c, d))])
    return SurfaceFile(Path("mesh.ply"), rows, faces)


def plain(surface, sheet, name: str, spacing: float) -> None:
    """The same points as LAZ, batch by batch."""
    import laspy

    from surfkit.apps.maps.cloud import sample_evenly

    header = laspy.LasHeader(version="1.4", point_format=7)
    header.scales = np.full(3, 1e-4)
    with laspy.open(sheet.out / name, "w", header=header, do_compress=True) as writer:
        for places, colors in sample_evenly(surface, spacing**2):
            record = laspy.ScaleAwarePointRecord.zeros(len(places), header=header)
            record.x, record.y, record.z = sheet.grid.to_map(places).T
            for channel, color in enumerate(("red", "green", "blue")):
                record[color] = colors[:, channel].astype(np.uint16) * 257
            writer.write_points(record)


def cloud(kind: str, millions: float) -> dict[str, float]:
    """Write one, and tell what it took."""
    import rasterio

    from surfkit.apps.maps.cloud import write_cloud
    from surfkit.apps.maps.geotiff import GeoTiffSettings, workshop
    from surfkit.apps.maps.map_grid import MapGrid

    surface, spacing = mesh(), SIDE / (1e6 * millions) ** 0.5
    grid = MapGrid.around(np.eye(3), 1.0, (0, 0, SIDE, SIDE))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with tempfile.TemporaryDirectory() as folder, workshop(Path(folder), ()) as unfinished:
        sheet = GeoTiffSettings(grid, rasterio.CRS.from_epsg(32633), unfinished, Path(folder))
        start, worked = time.perf_counter(), time.process_time()
        (plain if kind == "laz" else write_cloud)(surface, sheet, "points.laz", spacing)
        seconds, worked = time.perf_counter() - start, time.process_time() - worked
        size = (Path(folder) / "points.laz").stat().st_size
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return {
        "s": round(seconds, 1),
        "CPU s": round(worked, 1),
        "MB": round(size / 1e6, 1),
        "peak MB": peak // 1024,
        "before MB": before // 1024,
    }


def main() -> None:
    """Print the figures, and keep them if asked to."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("--points", type=float, nargs="+", default=[5, 20])
    ask.add_argument("--keep", action="store_true")
    ask.add_argument("--one", nargs=2)
    asked = ask.parse_args()
    if asked.one:
        print(json.dumps(cloud(asked.one[0], float(asked.one[1]))))
        return
    figures = {}
    for millions in asked.points:
        for kind in ("laz", "copc"):
            made = subprocess.run(
                [sys.executable, __file__, "--one", kind, str(millions)], capture_output=True, check=True
            )
            figures[f"{kind}, {millions:g} M points"] = json.loads(made.stdout)
    print(json.dumps(figures, indent=2))
    if asked.keep:
        print(save("copc", figures))


if __name__ == "__main__":
    main()
