"""Screened Poisson reconstruction from what the views see, as SuGaR (Guédon and Lepetit 2024) makes its meshes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import ModuleType
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.events import Progress, emit
from surfkit.core.optional import needed
from surfkit.mesh.base import Mesh, Mesher, MeshInput

MIN_ORIENTED_POINTS = 100
"""Fewest oriented points that make a surface."""


def require_open3d(what: str) -> ModuleType:
    """Open3D, which `what` needs; BadInput that says what to install where it cannot be loaded."""
    with needed("open3d", what):
        import open3d
    return open3d


@dataclass(frozen=True)
class Poisson(Mesher):
    """Screened Poisson reconstruction (Kazhdan and Hoppe 2013) from oriented points of all views; needs open3d."""

    octree: int = 10
    """Depth of the octree: the longest side of the scene is divided into 2^octree cells."""

    points: int = 2_000_000
    """Number of oriented points, taken evenly from all views."""

    thin: float = 0.1
    """Share of the vertices to remove, those with the lowest point density: Poisson reconstruction closes open
    surfaces."""

    depth: Literal["median", "expected"] = "median"
    """Depth of a pixel: median is that of the splat where the accumulated opacity reaches 0.5, expected the mean of
    all."""

    def __post_init__(self) -> None:
        if not 3 <= self.octree <= 16:
            raise BadInput(f"mesh: poisson.octree is {self.octree}; it must be 3 to 16")
        if self.points < MIN_ORIENTED_POINTS or not 0 <= self.thin < 1:
            allowed = f"give {MIN_ORIENTED_POINTS} or more, and 0 or more below 1"
            raise BadInput(f"mesh: poisson.points is {self.points} and thin {self.thin}; {allowed}")

    def ready(self) -> None:
        """See `Mesher.ready`."""
        require_open3d("mesh:poisson")

    def mesh(self, subject: MeshInput) -> Mesh:
        """See `Mesher.mesh`."""
        share = -(-self.points // len(subject.views))
        found = [seen_pixels(subject, at, share, self.depth) for at in range(len(subject.views))]
        points, normals, colors = (torch.cat([getattr(p, n) for p in found]) for n in ("points", "normals", "colors"))
        kept, count = self.kept(subject, points), len(points)
        points, normals, colors = points[kept], normals[kept], colors[kept]
        if len(points) < MIN_ORIENTED_POINTS:
            raise BadInput(f"mesh: only {len(points)} pixels of {len(subject.views)} views have a depth; train longer")
        made = reconstructed(points, normals, colors, self.octree, self.thin, "mesh:poisson")
        return replace(made, facts={"points": count, "points_kept": len(points)})

    def kept(self, subject: MeshInput, points: Tensor) -> Tensor:
        """(P,) bool, which of the (P, 3) points of all views lie on a surface; by default all, for other meshers."""
        return torch.ones_like(points[:, 0], dtype=torch.bool)


@dataclass(frozen=True)
class SeenPixels:
    """Some pixels of a view that show a surface.

    Attributes:
        points: (P, 3) positions, local frame.
        rays: (P, 3) unit directions from the camera to them.
        normals: (P, 3) rendered normals, outward, of length 1.
        colors: (P, 3) in [0, 1].
    """

    points: Tensor
    rays: Tensor
    normals: Tensor
    colors: Tensor


def seen_pixels(subject: MeshInput, at: int, most: int, which: Literal["median", "expected"]) -> SeenPixels:
    """Pixels of a view that have a depth, at random `most` of them where there are more.

    Args:
        subject: What is to be meshed.
        at: Position of the view.
        most: How many.
        which: Depth that counts.
    """
    view = subject.views[at]
    camera, maps = view.camera, subject.draw(view)
    depth = maps.need("median") if which == "median" else maps.expected_depth()
    normal = maps.need("normal")
    length = normal.norm(dim=0)
    solid = (depth > 0) & (maps.need("alpha") > 0.5) & (length > 0)
    if (keep := subject.keep(at)) is not None:
        solid &= keep
    rows = solid.flatten().nonzero()[:, 0]
    rows = rows[torch.randperm(len(rows), generator=subject.generator)[:most].sort().values]
    turn, rays = camera.world_to_camera[:3, :3].float(), camera.rays()
    local = (rays * depth).flatten(1)[:, rows].T
    normals = (normal / length.clamp_min(1e-10)).flatten(1)[:, rows].T
    colors = maps.need("color").clamp(0, 1).flatten(1)[:, rows].T
    emit(Progress("taking points", at + 1, len(subject.views)))
    directions = torch.nn.functional.normalize(rays.flatten(1)[:, rows].T @ turn, dim=1)
    return SeenPixels(local @ turn + camera.centre.float(), directions, normals @ turn, colors)


def reconstructed(points: Tensor, normals: Tensor, colors: Tensor, octree: int, thin: float, what: str) -> Mesh:
    """Screened Poisson reconstruction of oriented points, without what lies beyond their box or is thinly seen.

    Args:
        points: (P, 3).
        normals: (P, 3) outward, of length 1.
        colors: (P, 3) in [0, 1].
        octree: Depth: the longest side is divided into 2^octree cells.
        thin: Share of the vertices to remove, those with the lowest point density.
        what: The component that needs open3d, for messages.

    Raises:
        BadInput: open3d cannot be loaded.
    """
    open3d = require_open3d(what)
    places, outward, shown = (value.double().cpu().numpy() for value in (points, normals, colors))
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(places))
    cloud.normals = open3d.utility.Vector3dVector(outward)
    cloud.colors = open3d.utility.Vector3dVector(shown)
    emit(Progress("Poisson reconstruction", 0, 1))
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        made, density = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
            cloud, depth=octree, n_threads=torch.get_num_threads()
        )
    emit(Progress("Poisson reconstruction", 1, 1))
    density, vertices = np.asarray(density), np.asarray(made.vertices)
    beyond = ((vertices < places.min(0)) | (vertices > places.max(0))).any(1)
    made.remove_vertices_by_mask(beyond | (density < np.quantile(density, thin)))
    return Mesh(
        np.asarray(made.vertices, np.float32),
        np.asarray(made.triangles, np.int32),
        (np.asarray(made.vertex_colors) * 255).round().astype(np.uint8),
    )
