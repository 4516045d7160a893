"""Flat Gaussians that are bound to the triangles of a mesh, and move with its vertices (SuGaR, section 4.3)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np
import torch
from torch import Tensor

from surfkit.plugin import (
    SH_C0,
    BadInput,
    Column,
    Columns,
    Flat3D,
    LearningRate,
    Mesh,
    Mesher,
    MeshInput,
    Primitive,
    Regularizer,
    SparsePoints,
    Splats,
    Surfel2D,
    facing,
    rotated,
    seeds,
    standard_columns,
)
from surfkit.scene.rotations import quaternions
from surfkit_sugar.density import gathered
from surfkit_sugar.triangles import SLIVER, corners, ellipses, frames, packed, pairs, turned

MOST = 1 << 24
"""Rows are kept as float32 numbers, which are whole up to here."""
MESH = ("vertices", "faces", "pairs")
"""Shared parameters: positions; the rows of each triangle's corners; the two triangles at each inner edge."""


@dataclass(frozen=True)
class MeshBound(Primitive):
    """Flat splats in the planes of triangles: places and normals are those of a mesh, whose vertices are trained in
    their stead (SuGaR, section 4.3)."""

    has_free_points: ClassVar[bool] = False

    draws: Literal["gaussian", "surfel"] = "gaussian"
    """What lies on the triangles: ellipsoids with a third scale of almost 0, as published, or discs (2DGS)."""

    def columns(self) -> Mapping[str, Column]:
        """See `Primitive.columns`. Triangle and place of a point keep their values, and decide its position."""
        standard, fixed = standard_columns(2, self.sh_degree), LearningRate(0.0)
        return {
            "means": replace(standard["means"], rate=fixed),
            "triangle": Column((), fixed),
            "place": Column((2,), fixed),
            "turn": Column((2,), standard["quats"].rate),
            **{name: standard[name] for name in ("scales", "opacities", "sh0", "sh_rest")},
            "vertices": Column((None, 3), standard["means"].rate, shared=True),
            "faces": Column((None, 3), fixed, shared=True),
            "pairs": Column((None, 2), fixed, shared=True),
        }

    def init(self, cloud: SparsePoints, generator: torch.Generator) -> Columns:
        """A triangle of its own for each point, which faces along its normal, or any way when it has none."""
        names = ("opacities", "sh0", "sh_rest", "scales")
        begun = seeds({name: column for name, column in self.columns().items() if name in names}, cloud)
        count = len(cloud.xyz)
        quats = torch.randn(count, 4, generator=generator) if cloud.normals is None else facing(cloud.normals)
        angles = torch.arange(3) * (2 * torch.pi / 3)
        around = torch.stack([angles.cos(), angles.sin(), torch.zeros(3)], 1)
        shift = 2 * begun["scales"].exp()[:, :1, None] * around  # the circle inside is half as large as that outside
        offsets = rotated(shift.reshape(-1, 3), quats.repeat_interleave(3, 0))
        vertices = cloud.xyz.float().repeat_interleave(3, 0) + offsets
        return self.on(vertices, torch.arange(3 * count).view(-1, 3), 1) | begun

    def on(self, vertices: Tensor, faces: Tensor, rows: int) -> Columns:
        """The raw columns of shape, of splats in each triangle as large as circles in as many rows; and the mesh.

        Args:
            vertices: (V, 3) local positions.
            faces: (F, 3) int64 rows of `vertices`; without slivers.
            rows: Splats at each edge of a triangle.
        """
        if max(len(vertices), len(faces)) > MOST:
            raise BadInput(f"a mesh of {len(vertices):,} vertices and {len(faces):,} triangles: {MOST:,} are the most")
        centres, radius = packed(rows)
        _, along, across = corners(vertices, faces)
        axes, turn = ellipses(along, across)
        each = len(centres)
        mesh = {"vertices": vertices, "faces": faces.to(vertices), "pairs": pairs(faces).to(vertices)}
        begun = {
            "triangle": torch.arange(len(faces)).repeat_interleave(each).to(vertices),
            "place": centres[:, 1:].repeat(len(faces), 1).to(vertices),
            "turn": turn.repeat_interleave(each, 0),
            "scales": (radius * axes).log().repeat_interleave(each, 0),
        }
        return begun | self.dependent(begun | mesh) | mesh

    def dependent(self, params: Columns) -> Columns:
        """See `Primitive.dependent`."""
        return {"means": located(params)[0]}

    def moved(self, params: Columns, shift: Tensor) -> Columns:
        """Refused: see `Primitive.has_free_points`."""
        raise BadInput("primitive mesh-bound: its points lie on triangles and cannot be moved alone")

    def activate(self, params: Columns, degree: int) -> Splats:
        """See `Primitive.activate`; the mesh goes along as shared tensors, and corners and weights of each splat."""
        means, along, across, rows = located(params)
        quats = quaternions(turned(frames(along, across), params["turn"]))
        flat = (Flat3D if self.draws == "gaussian" else Surfel2D)(sh_degree=self.sh_degree)
        place = params["place"].detach()
        weights = torch.cat([1 - place.sum(1, keepdim=True), place], 1)
        return replace(
            flat.activate(params | {"means": means, "quats": quats}, degree),
            extra={"corners": rows, "weights": weights},
            shared={name: params[name] for name in MESH},
        )


def located(params: Columns) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """(N, 3) positions of points, two edges (N, 3) of the triangle of each, and (N, 3) int64 rows of its corners."""
    faces, triangle = (params[name].detach().to(torch.int64) for name in ("faces", "triangle"))
    rows = faces[triangle]
    first, along, across = corners(params["vertices"], rows)
    place = params["place"]
    return first + place[:, :1] * along + place[:, 1:] * across, along, across, rows


def mesh_of(splats: Splats, what: str) -> tuple[Tensor, Tensor, Tensor]:
    """(V, 3) vertices, (F, 3) int64 faces and (E, 2) int64 pairs of triangles that splats are bound to.

    Raises:
        BadInput: They are bound to none, and `what` needs that.
    """
    if not set(MESH) <= set(splats.shared):
        raise BadInput(f"{what} needs splats that are bound to a mesh; add refine.0:bind-to-mesh, or leave it out")
    vertices, faces, both = (splats.shared[name] for name in MESH)
    return vertices, faces.detach().to(torch.int64), both.detach().to(torch.int64)


@dataclass(frozen=True)
class AdjacentNormals(Regularizer):
    """Mean of 1 - cos of the angle between the normals of triangles that share an edge (SuGaR, section 4.3); for splats
    that are bound to a mesh."""

    weight: float = 0.1
    """Loss weight."""

    def __post_init__(self) -> None:
        if self.weight < 0:
            raise BadInput(f"adjacent normals have weight {self.weight:g}; give 0 or more")

    def weight_at(self, index: int, steps: int) -> float:
        """The same at each step."""
        return self.weight

    def __call__(self, splats: Splats) -> Tensor:
        """The mean; 0 where no two triangles share an edge."""
        vertices, faces, both = mesh_of(splats, "regularizers.KEY:adjacent-normals")
        _, along, across = corners(vertices, faces)
        normals = frames(along, across)[:, :, 2]
        one, other = gathered(normals.T, both.T).unbind(1)
        return (1 - (one * other).sum(0)).sum() / max(1, len(both))


@dataclass(frozen=True)
class BoundMesh(Mesher):
    """The mesh that splats are bound to, as it has become; for models of refine.N:bind-to-mesh."""

    def mesh(self, subject: MeshInput) -> Mesh:
        """See `Mesher.mesh`; vertices have the mean colour of the splats around them."""
        vertices, faces, _ = mesh_of(subject.splats, "mesh:bound")
        splats = subject.splats
        colors = (0.5 + SH_C0 * splats.sh0[:, 0]).clamp(0, 1)
        rows, weights = (splats.extra[name] for name in ("corners", "weights"))
        total = colors.new_zeros(len(vertices), 4)
        for at in range(3):
            share = (weights[:, at] * splats.opacities)[:, None]
            total.index_add_(0, rows[:, at], torch.cat([share * colors, share], 1))
        mean = torch.where(total[:, 3:] > 0, total[:, :3] / total[:, 3:].clamp_min(1e-12), 0.5)
        return Mesh(
            vertices.detach().cpu().numpy().astype(np.float32),
            faces.cpu().numpy().astype(np.int32),
            (mean.detach() * 255).round().to(torch.uint8).cpu().numpy(),
            {"splats_on_triangles": len(splats)},
        )


def sound(vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """A mesh without slivers, and without vertices that belong to no triangle."""
    _, along, across = corners(vertices, faces)
    axes, _ = ellipses(along, across)
    kept = faces[(axes[:, 1] > SLIVER * axes[:, 0]) & (axes[:, 0] > 0)]
    used, renumbered = torch.unique(kept, return_inverse=True)
    return vertices[used], renumbered.view(-1, 3)
