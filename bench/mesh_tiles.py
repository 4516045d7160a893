"""Memory of `mesh:visibility`, and how well its tiles meet, as the scene grows: `python bench/mesh_tiles.py`.

Rough made-up ground, seen straight from above with exact depths, by 36 views and by sixteen times as many. Each is
meshed in a process of its own with the same budget of memory, and the small one also without tiles; the peak is that of
the process less what it had before. Errors are heights of vertices less those of the ground.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import torch
from machine import save

from surfkit.core.memory import highest_memory_bytes
from surfkit.mesh.base import MeshInput
from surfkit.mesh.visibility import Visibility
from surfkit.raster.api import Maps, Splats
from surfkit.raster.reference import Reference
from surfkit.scene.camera import Camera
from surfkit.scene.scene import Frame, View

SIZE, FOCAL, HEIGHT, STEP = (200, 150), 150.0, 60.0, 30.0
"""Pixels, pixels, metres above the ground, and metres from one view to the next."""
MESHER = Visibility(sky=True, stereo=0.0, flat=0.0)


def ground(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Heights in metres: hills, and bumps that leave few places flat."""
    hills = 2 * np.sin(x / 31) * np.cos(y / 23)
    return hills + 0.5 * np.sin(x / 1.9 + np.sin(y / 7)) * np.sin(y / 2.3) + 0.2 * np.sin(x * 1.3) * np.cos(y * 1.1)


def drawn(camera: Camera) -> Maps:
    """What a camera that looks straight down sees of the ground."""
    centre = camera.centre.numpy()
    rays = camera.rays(torch.float64).numpy()
    depth = np.full(rays.shape[1:], HEIGHT)
    for _ in range(60):
        depth = 0.5 * depth + 0.5 * (centre[2] - ground(centre[0] + depth * rays[0], centre[1] - depth * rays[1]))
    x, y = centre[0] + depth * rays[0], centre[1] - depth * rays[1]
    slope = [(ground(x + dx, y + dy) - ground(x - dx, y - dy)) / 2e-3 for dx, dy in ((1e-3, 0), (0, 1e-3))]
    normal = torch.from_numpy(np.stack([-slope[0], slope[1], -np.ones_like(x)])).float()
    found = torch.from_numpy(depth).float()
    return Maps(torch.full((3, *depth.shape), 0.5), torch.ones_like(found), found, found, normal / normal.norm(dim=0))


def scene(across: int, budget: int) -> MeshInput:
    """A square of views."""
    views = []
    for at in range(across**2):
        pose = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
        row, column = divmod(at, across)
        pose[:3, 3] = -pose[:3, :3] @ torch.tensor([STEP * column, STEP * row, HEIGHT], dtype=torch.float64)
        camera = Camera(pose, FOCAL, FOCAL, SIZE[0] / 2, SIZE[1] / 2, *SIZE)
        views.append(View(f"{at}.png", camera, Path(f"{at}.png")))
    middle = STEP * (across - 1) / 2
    splats = Splats(  # that only tell where the surface is
        "surfel",
        torch.tensor([[middle, middle, 0.0]]),
        torch.ones(1, 4),
        torch.ones(1, 2),
        torch.ones(1),
        torch.ones(1, 1, 3),
    )
    frame = Frame(np.zeros(3), 1.0, metres=1.0)
    return MeshInput(splats, views, lambda view: drawn(view.camera), Reference(), 0.1, frame, budget)


def one(across: int, budget: int) -> dict[str, float]:
    """Figures of a mesh, in this process."""
    given = scene(across, budget)
    before, start = highest_memory_bytes(), time.process_time()
    mesh = MESHER.mesh(given)
    x, y, z = mesh.vertices.astype(float).T
    edges = np.sort(np.stack([mesh.faces, np.roll(mesh.faces, -1, 1)], -1).reshape(-1, 2), 1)
    rim = STEP * (across - 1)
    sides, counts = np.unique(edges, axis=0, return_counts=True)
    free = mesh.vertices[sides[counts == 1]].mean(1)
    inside = ((free[:, :2] > 0) & (free[:, :2] < rim)).all(1)
    return {
        "views": across**2,
        "points": mesh.facts["points"],
        "triangles": len(mesh.faces),
        "peak_gb": (highest_memory_bytes() - before) / 1e9,
        "cpu_seconds": time.process_time() - start,
        "error_median_m": float(np.median(np.abs(z - ground(x, y)))),
        "error_99_m": float(np.quantile(np.abs(z - ground(x, y)), 0.99)),
        "edges": len(sides),
        "free_edges_inside": int(inside.sum()),
        "crowded_edges": int((counts > 2).sum()),
    }


def main() -> None:
    """Measure all, each in a process of its own, and keep the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--across", type=int, default=6, help="views along a side of the small scene")
    parser.add_argument("--budget", type=float, default=1.5e8, help="bytes; the small scene is cut too")
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.one:
        print(json.dumps(one(given.one, int(given.budget))))
        return
    rows = []
    for across, budget in ((given.across, 1e12), (given.across, given.budget), (4 * given.across, given.budget)):
        words = [sys.executable, __file__, "--one", str(across), "--budget", str(budget)]
        rows.append(
            json.loads(subprocess.run(words, check=True, capture_output=True, text=True).stdout.splitlines()[-1])
        )
        print({"budget_gb": budget / 1e9, **rows[-1]})
    save("mesh_tiles", {"budget_bytes": given.budget, "rows": rows})


if __name__ == "__main__":
    main()
