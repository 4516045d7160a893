"""What a request for the coordinates under the pointer costs the server of `surfkit view`.

    python bench/cursor.py --size 3000000

A city of so many surfels, a mesh of so many triangles and so many points are looked at from where the page begins, each
through the web server and in the way of a click, at random pixels of the middle. CPU time is that of the process, all
threads.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
import urllib.request
from collections.abc import Mapping
from http import HTTPStatus
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch
from machine import save
from view import SIZE, city
from viser import transforms

from surfkit.apps.view.browser_camera import WORLD, ray_through
from surfkit.apps.view.measure_clicks import coordinates
from surfkit.apps.view.server import Address, served
from surfkit.apps.view.shared_cache import SharedCache
from surfkit.apps.view.viewer_page import first_view
from surfkit.apps.view.viewer_scene import ViewerPoints, ViewerScene
from surfkit.mesh.base import Mesh
from surfkit.primitives.model import SplatModel, primitive_of
from surfkit.raster.select import select
from surfkit.runs.methods.base import Reconstruction
from surfkit.runs.run_method import with_drawing
from surfkit.scene.scene import Frame

UP = np.array([0.0, 0.0, 1.0])
FRAME = Frame(np.array([492_000.0, 5_260_000.0, 430.0]), 0.01, 1.0, "EPSG:32632")


def subjects(size: int) -> dict[str, ViewerScene]:
    """What is looked at, by name."""
    table = city(size)
    primitive = primitive_of(table)
    splats = SplatModel(primitive, primitive.from_table(table, torch.Generator()), table.sh_degree)
    draw = with_drawing(Reconstruction(splats=splats), select("cpu")[0]).draw
    side = math.isqrt(size // 2) + 1
    x, y = np.meshgrid(*[np.linspace(-1, 1, side)] * 2)
    hills = np.stack([x, y, 0.1 * np.sin(40 * x) * np.cos(30 * y)], axis=-1).reshape(-1, 3).astype(np.float32)
    at = np.arange(side * side, dtype=np.int32).reshape(side, side)
    a, b, c, d = (corner.ravel() for corner in (at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]))
    mesh = Mesh(hills, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))
    points = ViewerPoints(table.means.numpy(), np.zeros((size, 3), np.uint8))
    return {
        "splats": ViewerScene(Path("city"), FRAME, UP, splats=table, draw=draw),
        "mesh": ViewerScene(Path("hills"), FRAME, UP, mesh=mesh),
        "points": ViewerScene(Path("points"), FRAME, UP, points=points),
    }


def measured(subject: ViewerScene, count: int) -> dict[str, float]:
    """Milliseconds of a request: CPU time in the middle and at the slow end, and time that passes."""
    shelf, draw = SharedCache(subject), np.random.default_rng(0)
    up, at, middle = first_view(subject)
    ahead = (middle - at) / np.linalg.norm(middle - at)
    right = np.cross(ahead, up) / np.linalg.norm(np.cross(ahead, up))
    turn = transforms.SO3.from_matrix(np.stack([right, np.cross(ahead, right), ahead], axis=1))
    camera = SimpleNamespace(wxyz=turn.wxyz, position=at * WORLD, fov=math.radians(30))

    began = time.process_time()
    shelf.prepare()
    shelf.pick(*ray_through(camera, 0.0, 0.0), mesh=True)  # type: ignore[arg-type]
    ready = time.process_time() - began

    def answer(asked: Mapping[str, str]) -> tuple[HTTPStatus, str]:
        place = shelf.pick(*ray_through(camera, float(asked["x"]), float(asked["y"])), mesh=True)  # type: ignore[arg-type]
        return HTTPStatus.OK, "" if place is None else coordinates(place, subject.frame, subject.up)

    cpu, wall, hits = [], [], 0
    with served(Address(), "bench") as page:
        page.script.set("", answer, "")
        at_url, _, token = page.url.partition("?token=")
        port = at_url.rstrip("/").rpartition(":")[2]
        for _ in range(count):
            x, y = draw.uniform(-1, 1, 2) * [SIZE["width"] / SIZE["height"], 1]
            asked = urllib.request.Request(f"{at_url}surfkit/ask?x={x}&y={y}")
            asked.add_header("Cookie", f"surfkit-view-{port}={token}")
            began = time.process_time(), time.perf_counter()
            with urllib.request.urlopen(asked) as found:
                hits += bool(found.read())
            cpu.append(1e3 * (time.process_time() - began[0]))
            wall.append(1e3 * (time.perf_counter() - began[1]))
    return {
        "CPU ms": round(float(np.median(cpu)), 1),
        "CPU ms, one in ten": round(float(np.percentile(cpu, 90)), 1),
        "ms": round(float(np.median(wall)), 1),
        "on the surface": hits,
        "of": count,
        "CPU s to prepare": round(ready, 1),
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=3_000_000)
    parser.add_argument("--requests", type=int, default=60)
    asked = parser.parse_args()
    rows = {}
    for name, subject in subjects(asked.size).items():
        rows[name] = measured(subject, asked.requests)
        print(name, rows[name], flush=True)
    save("cursor", {"size": asked.size, "rows": rows})
    return 0


if __name__ == "__main__":
    sys.exit(main())
