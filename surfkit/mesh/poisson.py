"""Screened Poisson reconstruction from what the views see, as SuGaR (Guédon and Lepetit 2024) makes its meshes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.events import Progress, emit
from surfkit.mesh.base import Mesh, Mesher, MeshInput
from surfkit.mesh.simplify import require_open3d

ENOUGH = 100
"""Fewest oriented points that make a surface."""


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
        if self.points < ENOUGH or not 0 <= self.thin < 1:
            allowed = f"give {ENOUGH} or more, and 0 or more below 1"
            raise BadInput(f"mesh: poisson.points is {self.points} and thin {self.thin}; {allowed}")

    def ready(self) -> None:
        """See `Mesher.ready`."""
        require_open3d("mesh:poisson")

    def mesh(self, subject: MeshInput) -> Mesh:
        """See `Mesher.mesh`."""
        open3d = require_open3d("mesh:poisson")
        found = [self._seen(subject, at) for at in range(len(subject.views))]
        points, normals, colors = (torch.cat(parts).double().numpy() for parts in zip(*found, strict=True))
        if len(points) < ENOUGH:
            raise BadInput(f"mesh: only {len(points)} pixels of {len(subject.views)} views have a depth; train longer")
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
        cloud.normals = open3d.utility.Vector3dVector(normals)
        cloud.colors = open3d.utility.Vector3dVector(colors)
        emit(Progress("Poisson reconstruction", 0, 1))
        with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
            made, density = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
                cloud, depth=self.octree, n_threads=torch.get_num_threads()
            )
        emit(Progress("Poisson reconstruction", 1, 1))
        density, vertices = np.asarray(density), np.asarray(made.vertices)
        beyond = ((vertices < points.min(0)) | (vertices > points.max(0))).any(1)
        made.remove_vertices_by_mask(beyond | (density < np.quantile(density, self.thin)))
        return Mesh(
            np.asarray(made.vertices, np.float32),
            np.asarray(made.triangles, np.int32),
            (np.asarray(made.vertex_colors) * 255).round().astype(np.uint8),
        )

    def _seen(self, subject: MeshInput, at: int) -> tuple[Tensor, Tensor, Tensor]:
        """(P, 3) positions, outward normals and colours in [0, 1] of some pixels of a view."""
        view = subject.views[at]
        camera, maps = view.camera, subject.draw(view)
        depth = maps.median if self.depth == "median" else maps.expected_depth()
        length = maps.normal.norm(dim=0)
        solid = (depth > 0) & (maps.alpha > 0.5) & (length > 0)
        if (keep := subject.keep(at)) is not None:
            solid &= keep
        rows = solid.flatten().nonzero()[:, 0]
        share = -(-self.points // len(subject.views))
        rows = rows[torch.randperm(len(rows), generator=subject.generator)[:share].sort().values]
        turn = camera.world_to_camera[:3, :3].float()
        local = (camera.rays() * depth).flatten(1)[:, rows].T
        normals = (maps.normal / length.clamp_min(1e-10)).flatten(1)[:, rows].T
        colors = maps.color.clamp(0, 1).flatten(1)[:, rows].T
        emit(Progress("taking points", at + 1, len(subject.views)))
        return local @ turn + camera.centre.float(), normals @ turn, colors
