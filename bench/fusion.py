"""How good a mesh can be: exact and spoilt depth maps of a data set with exact geometry, fused and measured.

`python bench/fusion.py PACK` draws gt/mesh.ply of a data set as every training photograph would see it, spoils the maps
as renders of splats are (smooth and white noise, patches at another depth, blurred edges), fuses both in each of the
ways of `ROWS`, and measures precision, recall and F1 against gt/mesh.ply, and recall against gt/points.ply, where there
is one: what photographs can see. The truth is neither moved nor resized.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from machine import save
from scipy.ndimage import gaussian_filter

from surfkit.evaluate.geometry.comparison import Comparison, make_side, truth_side, volume
from surfkit.evaluate.geometry.repetition import Measurement
from surfkit.evaluate.geometry.scores import nearest, shares, tree
from surfkit.evaluate.geometry.surface_file import read_surface
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.read import read
from surfkit.mesh.base import Mesh, MeshInput
from surfkit.mesh.clean import clean
from surfkit.mesh.geometric_consistency import GeometricConsistency
from surfkit.mesh.mesh_export import write_mesh
from surfkit.mesh.shade import draw_faces
from surfkit.mesh.stereo import points
from surfkit.mesh.tsdf import TSDF
from surfkit.raster.api import Maps
from surfkit.raster.reference import Reference
from surfkit.scene.scene import Frame, Scene, View

ROWS = {
    "as it is": TSDF(),
    "fewer views needed": TSDF(least_views=0.25),
    "agreement": TSDF(least_views=0.25, trust=GeometricConsistency()),
    "agreement, what is alone left out": TSDF(least_views=0.25, trust=GeometricConsistency(alone=0.0)),
    "agreement, floaters dropped": TSDF(least_views=0.25, trust=GeometricConsistency(), floaters=1.0),
}


class Truth:
    """A mesh, and what cameras see of it."""

    def __init__(self, path: Path, side: float) -> None:
        import trimesh

        found = read_surface(path)
        # Triangles that reach behind a camera would be left out.
        self.vertices, self.faces = trimesh.remesh.subdivide_to_size(found.vertices(), found.faces, side, max_iter=20)
        a, b, c = (self.vertices[self.faces[:, i]] for i in range(3))
        normals = np.cross(b - a, c - a)
        self.normals = normals / np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-30)

    def seen(self, view: View, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
        """(H, W) depth in local units, 0 for none, and (3, H, W) normals in the camera's frame."""
        camera, pose = view.camera, frame.input_pose(view.camera.world_to_camera)
        local = self.vertices @ pose[:3, :3].T + pose[:3, 3]
        z = np.where(local[:, 2] > 1e-6, local[:, 2], np.nan)
        places = np.stack([local[:, 0] / z * camera.fx + camera.cx, local[:, 1] / z * camera.fy + camera.cy, z], 1)
        depth, face = draw_faces(places, self.faces, camera.width, camera.height)
        there, rays = np.isfinite(depth), camera.rays(torch.float64).numpy()
        normal = ((self.normals @ pose[:3, :3].T)[face] * there[..., None]).transpose(2, 0, 1)
        normal = np.where((normal * rays).sum(0) > 0, -normal, normal)
        return np.where(there, depth, 0) * frame.scale, normal


def spoilt(depth: np.ndarray, options: argparse.Namespace, draw: np.random.Generator) -> np.ndarray:
    """A depth map with errors that are its own."""
    there = depth > 0
    if options.blur:
        full = gaussian_filter(there.astype(float), options.blur).clip(1e-9)
        depth = gaussian_filter(depth, options.blur) / full
    smooth = gaussian_filter(draw.normal(size=depth.shape), 6)
    depth = depth * (1 + options.noise * (0.7 * smooth / smooth.std() + 0.7 * draw.normal(size=depth.shape)))
    y, x = np.indices(depth.shape)
    patches = np.zeros(depth.shape, bool)
    while patches.mean() < options.patches:
        radius = draw.uniform(0.006, 0.036) * depth.shape[1]
        patch = (y - draw.uniform(0, len(y))) ** 2 + (x - draw.uniform(0, x.shape[1])) ** 2 < radius**2
        depth = np.where(patch, depth * (1 + draw.choice([-1, 1]) * draw.uniform(0.03, 0.3)), depth)
        patches |= patch
    return np.where(there, depth, 0)


def maps_of(depth: np.ndarray, normal: np.ndarray) -> Maps:
    """As a rasterizer would give them, in grey."""
    plane, alpha = torch.from_numpy(depth).float(), torch.from_numpy(depth > 0).float()
    return Maps(0.5 * alpha.expand(3, -1, -1), alpha, plane, plane, torch.from_numpy(normal).float())


def subject(scene: Scene, maps: list[Maps]) -> MeshInput:
    """What a mesher is given."""
    by_name = {view.name: some for view, some in zip(scene.train, maps, strict=True)}

    def draw(view: View) -> Maps:
        return by_name[view.name]

    return MeshInput(points(scene.train, draw), scene.train, draw, Reference(), 0.01, scene.frame, 4 << 30)


def score(mesh: Mesh, scene: Scene, pack: Path, tau: float, crop: object) -> dict[str, float]:
    """Shares within `tau`."""
    settings = Comparison(tau=tau)
    theirs, _ = truth_side(read_surface(pack / "gt/mesh.ply"), settings)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mesh.ply"
        write_mesh(path, clean(mesh, 50, 50)[0], scene.frame)
        measure = Measurement(
            make_side(read_surface(path), None, None, tau), theirs, crop, tau, np.random.default_rng(0)
        )
        found = measure.draw(np.eye(4), "none")
    precision, recall, f1 = shares(found.distances, tau)
    row = {"precision": precision, "recall": recall, "f1": f1}
    if (pack / "gt/points.ply").exists():
        cloud = read_surface(pack / "gt/points.ply").vertices()
        apart = nearest(tree(found.reconstruction), cloud[crop.inside(cloud)])
        row["recall of what is seen"] = float((apart < tau).mean())
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("pack", type=Path)
    parser.add_argument("--scale", type=float, default=2.0)
    parser.add_argument("--tau", type=float, default=0.5, help="units of the data set")
    parser.add_argument("--voxel", type=float, nargs="+", default=[0.5], help="units of the data set")
    parser.add_argument("--noise", type=float, default=0.005, help="share of the depth")
    parser.add_argument("--patches", type=float, default=0.1, help="share of the pixels that are wrong")
    parser.add_argument("--blur", type=float, default=1.5, help="of edges, pixels")
    parser.add_argument("--exact", action="store_true", help="exact depth alone: what the mesher loses")
    options = parser.parse_args()
    scene = read(Data(options.pack, scale=options.scale, metres_per_unit=1.0))
    truth, draw = Truth(options.pack / "gt/mesh.ply", 50 * options.tau), np.random.default_rng(0)
    exact = [truth.seen(view, scene.frame) for view in scene.train]
    inputs = {"exact": [maps_of(*some) for some in exact]}
    if not options.exact:
        inputs["spoilt"] = [maps_of(spoilt(depth, options, draw), normal) for depth, normal in exact]
    some = truth_side(read_surface(options.pack / "gt/mesh.ply"), Comparison(tau=options.tau))[0].points(draw)
    crop, _ = volume(some, Comparison(), scene.train, scene.frame, (np.eye(4), options.tau))
    rows = []
    for name, maps in inputs.items():
        for voxel in options.voxel:
            for label, mesher in ROWS.items():
                began = time.process_time()
                mesh = replace(mesher, voxel=voxel).mesh(subject(scene, maps))
                seconds = time.process_time() - began
                found = score(mesh, scene, options.pack, options.tau, crop)
                rows.append({"depth": name, "voxel": voxel, "row": label, **found, "CPU s": round(seconds, 1)})
                print("  ".join(f"{v:.3f}" if isinstance(v, float) else str(v) for v in rows[-1].values()), flush=True)
    save("fusion", {"pack": options.pack.name, "scale": options.scale, "tau": options.tau, "rows": rows})


if __name__ == "__main__":
    main()
