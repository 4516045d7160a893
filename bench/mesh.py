"""Measure the fusion of depth maps on a made-up city of 1.44 km2: `python bench/mesh.py`.

Ours and Open3D's VoxelBlockGrid fuse the same exact depth maps in turns, with the same voxels and truncation, and ours
with larger voxels, whose mean error is about theirs; memory is that of a process that does only the one. Then all
views at 1 m, with the memory after each part of them, and a part of the city at 0.1 m in tiles within a budget. Wall
times are of a machine that may be doing other things: compare the ratios, and see the processor times of all threads
together beside them.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import torch
from machine import RESULTS, save

from surfkit.mesh.base import MeshInput
from surfkit.mesh.fusion_image import picture
from surfkit.mesh.lattice import Lattice
from surfkit.mesh.native_grid import NativeGrid
from surfkit.mesh.shade import draw_faces
from surfkit.mesh.tsdf import TSDF
from surfkit.raster.api import Maps, Splats
from surfkit.raster.reference import Reference
from surfkit.scene.camera import Camera
from surfkit.scene.scene import Frame, View

SIZE = (800, 600)
FOCAL = 700.0
HALF = 600.0
"""Metres from the middle of the city to its border."""


class City:
    """Houses on a plane, and what cameras above them see."""

    def __init__(self, half: float = HALF, margin: float = 250, seed: int = 0) -> None:
        draw = np.random.default_rng(seed)
        boxes = [(-half - margin, -half - margin, -1, half + margin, half + margin, 0)]
        for x in np.arange(-half, half, 40):
            for y in np.arange(-half, half, 40):
                wide, deep, high = *draw.uniform(14, 30, 2), draw.uniform(6, 40)
                boxes.append((x + 4, y + 4, 0, x + 4 + wide, y + 4 + deep, high))
        unit = np.indices((2, 2, 2)).reshape(3, -1).T  # x slowest
        sides = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
        quads = np.concatenate([sides[:, [0, 1, 2]], sides[:, [0, 2, 3]]])
        corners = np.array(boxes).reshape(-1, 2, 3)
        self.vertices = np.stack([corners[:, unit[:, axis], axis] for axis in range(3)], 2).reshape(-1, 3)
        self.faces = (quads + 8 * np.arange(len(boxes))[:, None, None]).reshape(-1, 3).astype(np.int32)
        self.colors = draw.integers(40, 220, (len(self.faces), 3)).astype(np.float32) / 255
        self.half, self.margin = half, margin

    def cameras(self, count: int, height: float, seed: int = 1) -> list[Camera]:
        """A third looks down, the others 39 degrees off that along x or y."""
        draw, found = np.random.default_rng(seed), []
        for at in range(count):
            x, y = draw.uniform(-self.half, self.half, 2)
            aim = np.array([0.8 * (at % 3 == 1), 0.8 * (at % 3 == 2), -1.0]) * np.where(draw.random(3) < 0.5, -1, 1)
            z = aim * [1, 1, np.sign(-aim[2])]
            z /= np.linalg.norm(z)
            across = np.cross(z, [0, 0, 1] if abs(z[2]) < 0.95 else [0, 1, 0])
            across /= np.linalg.norm(across)
            pose = np.eye(4)
            pose[:3, :3] = across, np.cross(z, across), z
            pose[:3, 3] = -pose[:3, :3] @ [x, y, height]
            found.append(Camera(torch.from_numpy(pose), FOCAL, FOCAL, SIZE[0] / 2, SIZE[1] / 2, *SIZE))
        return found

    def see(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """(H, W) float32 depth, 0 for none, and (3, H, W) float32 colour."""
        pose = camera.world_to_camera.numpy()
        # Triangles that reach behind the camera would be left out, so the ground is cut to what lies before it.
        local = self.fine @ pose[:3, :3].T + pose[:3, 3]
        z = np.where(local[:, 2] > 1, local[:, 2], np.nan)
        places = np.stack([local[:, 0] / z * camera.fx + camera.cx, local[:, 1] / z * camera.fy + camera.cy, z], 1)
        depth, face = draw_faces(places, self.fine_faces, camera.width, camera.height)
        color = np.where(face[..., None] >= 0, self.fine_colors[face], 0).transpose(2, 0, 1)
        return np.where(np.isfinite(depth), depth, 0).astype(np.float32), np.ascontiguousarray(color)

    def prepare(self) -> City:
        """Cut the ground into squares of about 50 m."""
        reach = self.half + self.margin
        steps = np.linspace(-reach, reach, 1 + round(reach / 25))
        x, y = np.meshgrid(steps, steps, indexing="ij")
        grid = np.stack([x, y, np.zeros_like(x)], 2).reshape(-1, 3)
        at = np.arange(len(grid)).reshape(len(steps), -1)
        a, b, c, d = (p.ravel() for p in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]))
        ground = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
        self.fine = np.concatenate([self.vertices[8:], grid])
        self.fine_faces = np.concatenate([self.faces[12:] - 8, ground + len(self.vertices) - 8]).astype(np.int32)
        tint = np.random.default_rng(2).uniform(0.2, 0.8, (len(ground), 3)).astype(np.float32)
        self.fine_colors = np.concatenate([self.colors[12:], tint])
        return self

    def error(self, vertices: np.ndarray) -> float:
        """Mean distance of vertices to the city, metres."""
        import open3d

        scene = open3d.t.geometry.RaycastingScene()
        scene.add_triangles(self.vertices.astype(np.float32), self.faces.astype(np.uint32))
        some = np.random.default_rng(3).permutation(len(vertices))[:200_000]
        return float(scene.compute_distance(open3d.core.Tensor(vertices[some].astype(np.float32))).numpy().mean())


class Ours:
    """Our grid."""

    def __init__(self, voxel: float) -> None:
        self.voxel, self.grid = voxel, NativeGrid(Lattice(voxel, 4 * voxel))

    def fuse(self, depth: np.ndarray, color: np.ndarray, camera: Camera) -> None:
        maps = Maps(torch.from_numpy(color))
        self.grid.fuse(picture(torch.from_numpy(depth), maps, camera, self.voxel, 4 * self.voxel), True)

    def vertices(self) -> np.ndarray:
        piece = self.grid.surface(1)
        used = np.zeros(len(piece.vertices), bool)
        used[piece.faces] = True
        return piece.vertices[used]

    def facts(self) -> dict:
        return {"blocks": self.grid.blocks, "MB of the grid": round(self.grid.bytes / 1e6)}


class VoxelBlocks:
    """Open3D's VoxelBlockGrid on the processor, with room for all blocks from the start."""

    def __init__(self, voxel: float) -> None:
        import open3d

        self.o3d = open3d
        names, kinds = ("tsdf", "weight", "color"), (open3d.core.float32,) * 3
        self.grid = open3d.t.geometry.VoxelBlockGrid(names, kinds, ((1,), (1,), (3,)), voxel, 16, ROOM)

    def fuse(self, depth: np.ndarray, color: np.ndarray, camera: Camera) -> None:
        # It takes the pixel that a coordinate falls in, so the principal point is measured from the corner, as ours.
        core, image = self.o3d.core, self.o3d.t.geometry.Image
        lens = core.Tensor([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]], core.float64)
        pose = core.Tensor(camera.world_to_camera.numpy())
        picture = image(core.Tensor(depth[..., None]))
        photo = image(core.Tensor(np.ascontiguousarray(color.transpose(1, 2, 0))))
        blocks = self.grid.compute_unique_block_coordinates(picture, lens, pose, 1.0, 1e4, 4.0)
        self.grid.integrate(blocks, picture, photo, lens, lens, pose, 1.0, 1e4, 4.0)

    def vertices(self) -> np.ndarray:
        return self.grid.extract_triangle_mesh(0.5).vertex.positions.numpy()

    def facts(self) -> dict:
        return {"blocks": self.grid.hashmap().size()}


ROOM = 27_000
"""Blocks of Open3D's for up to 100 views at 1 m; with less, it would hold everything twice while it grows."""
EQUAL = 1.35
"""Voxels of ours that give about the mean error of Open3D's, for each of its voxels."""
ENGINES = {"ours": Ours, "Open3D": VoxelBlocks, "ours, equal error": lambda voxel: Ours(EQUAL * voxel)}


def rss() -> float:
    """The most memory so far, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def alone(engine: str, views: int, voxel: float) -> dict:
    """Memory of a process that fuses with one of the two, above what it had before; then with the mesh."""
    import open3d  # noqa: F401 (in both, so that its libraries are in neither difference)

    city = City().prepare()
    cameras = city.cameras(views, 250)
    city.see(cameras[0])
    before = rss()
    made = ENGINES[engine](voxel)
    for camera in cameras:
        made.fuse(*city.see(camera), camera)
    fused = rss()
    made.vertices()
    return {"MB fused": round(fused - before), "MB with mesh": round(rss() - before), **made.facts()}


def side_by_side(views: int, voxel: float) -> dict:
    """Time of each frame and error of the mesh, in turns."""
    city = City().prepare()
    engines = {name: kind(voxel) for name, kind in ENGINES.items()}
    times: dict[str, list] = {name: [] for name in engines}
    for camera in city.cameras(views, 250):
        depth, color = city.see(camera)
        for name, engine in engines.items():
            began, spent = time.perf_counter(), time.process_time()
            engine.fuse(depth, color, camera)
            times[name].append((1e3 * (time.perf_counter() - began), 1e3 * (time.process_time() - spent)))
    found = {}
    for name, engine in engines.items():
        began = time.perf_counter()
        vertices = engine.vertices()
        wall, cpu = np.median(times[name], axis=0)
        found[name] = {
            "ms a frame, wall": round(wall, 1),
            "ms a frame, processor": round(cpu, 1),
            "s to extract": round(time.perf_counter() - began, 2),
            "vertices": len(vertices),
            "mean error m": round(city.error(vertices), 4),
        }
    return found


def whole_city(views: int, voxel: float) -> dict:
    """All views at one size of voxels, with the memory after each part of them."""
    city = City().prepare()
    cameras = city.cameras(views, 250)
    city.see(cameras[0])
    before, made, times, memory = rss(), Ours(voxel), [], {}
    for at, camera in enumerate(cameras, 1):
        depth, color = city.see(camera)
        began, spent = time.perf_counter(), time.process_time()
        made.fuse(depth, color, camera)
        times.append((1e3 * (time.perf_counter() - began), 1e3 * (time.process_time() - spent)))
        if at in (views // 8, views // 4, views // 2, views):
            memory[at] = round(rss() - before)
    began = time.perf_counter()
    vertices = made.vertices()
    seconds = time.perf_counter() - began
    wall, cpu = np.median(times, axis=0)
    late = np.median(np.array(times)[-views // 4 :], axis=0)
    return {
        "views": views,
        "voxel m": voxel,
        "ms a frame, wall": round(wall, 1),
        "ms a frame, processor": round(cpu, 1),
        "ms a frame, processor, last quarter": round(late[1], 1),
        "MB after views": memory,
        "MB with mesh": round(rss() - before),
        "s to extract": round(seconds, 2),
        "vertices": len(vertices),
        "mean error m": round(city.error(vertices), 4),
        **made.facts(),
    }


def in_tiles(views: int, voxel: float, budget: int) -> dict:
    """A part of the city through the mesher, in as many tiles as the budget makes necessary."""
    city = City(half=30, margin=30).prepare()
    cameras = city.cameras(views, 90)

    def draw(view: View) -> Maps:
        depth, color = (torch.from_numpy(a) for a in city.see(view.camera))
        return Maps(color, (depth > 0).float(), depth, depth)

    points = []
    for camera in cameras:
        depth = city.see(camera)[0][::8, ::8].reshape(-1)
        pose, rays = camera.world_to_camera.numpy(), camera.rays(torch.float64).numpy()[:, ::8, ::8].reshape(3, -1)
        points.append((pose[:3, :3].T @ ((rays * depth)[:, depth > 0] - pose[:3, 3:])).T)
    means = torch.from_numpy(np.concatenate(points)).float()
    count = len(means)
    fields = means, torch.ones(count, 4), torch.ones(count, 2), torch.ones(count), torch.ones(count, 1, 3)
    seen = [View(str(at), camera, Path()) for at, camera in enumerate(cameras)]
    given = MeshInput(Splats("surfel", *fields), seen, draw, Reference(), 0.1, Frame(np.zeros(3), 1.0, 1.0), budget)
    before, began = rss(), time.perf_counter()
    mesh = TSDF(voxel=voxel, depth_limit=160.0, least_views=0.03).mesh(given)
    seconds, peak = time.perf_counter() - began, rss() - before
    return {
        "voxel m": voxel,
        "views": views,
        "tiles": mesh.facts["tiles"],
        "budget MB": budget // 10**6,
        "MB": round(peak),
        "seconds": round(seconds, 1),
        "triangles": len(mesh.faces),
        "mean error m": round(city.error(mesh.vertices), 4),
    }


def apart(*words: object) -> dict:
    """What a part of this script gives in a process of its own."""
    command = [sys.executable, __file__, "--part", *map(str, words), "--threads", str(torch.get_num_threads())]
    return json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()[-1])


PARTS = {"alone": alone, "side_by_side": side_by_side, "whole_city": whole_city, "in_tiles": in_tiles}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--views", type=int, default=1000)
    parser.add_argument("--against", type=int, default=50, help="views for the comparison with Open3D")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--only", nargs="+", choices=("side by side", "city", "tiles"), help="keep the other results")
    parser.add_argument("--part", nargs="+", help=argparse.SUPPRESS)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    if options.part:
        name, *words = options.part
        values = [word if word in ENGINES else float(word) if "." in word else int(word) for word in words]
        print(json.dumps(PARTS[name](*values)))
        return
    kept = json.loads((RESULTS / "mesh.json").read_text())["figures"] if options.only else {}
    for part in options.only or ("side by side", "city", "tiles"):
        if part == "side by side":
            kept[part] = compared(options.against)
        elif part == "city":
            kept[part] = apart("whole_city", options.views, 1.0)
        else:
            kept[part] = apart("in_tiles", 60, 0.1, 1_150_000_000)
        print(json.dumps({part: kept[part]}, indent=2), flush=True)
    print(f"wrote {save('mesh', kept)}")


def compared(views: int) -> dict:
    """Both, and how many times less of everything ours takes."""
    found = apart("side_by_side", views, 1.0)
    for name in ENGINES:
        found[name] |= apart("alone", name, views, 1.0)
    other = found["Open3D"]
    for name in ("ours", "ours, equal error"):
        for what in ("ms a frame, wall", "ms a frame, processor", "MB fused", "MB with mesh", "mean error m"):
            found[f"Open3D / {name}: {what}"] = round(other[what] / found[name][what], 2)
    return found


if __name__ == "__main__":
    main()
