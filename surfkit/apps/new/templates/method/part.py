"""A whole way from a scene to a mesh, without splats."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import Delaunay
from surfkit.plugin import BadInput, Ground, Mesh, Method, MethodInput, Reconstruction


@dataclass(frozen=True)
class NewPart(Method):
    """Triangles between the sparse points of the ground, without any optimisation: a first look at a survey."""

    cell: float = 0.02
    """Side of the cells of the ground that keep one point each, as a share of the scene extent."""

    def __post_init__(self) -> None:
        if self.cell <= 0:
            raise BadInput(f"new-part.cell is {self.cell}; it must be more than 0")

    def reconstruct(self, given: MethodInput) -> Reconstruction:
        """See `Method.reconstruct`."""
        cloud = given.scene.cloud
        centres = torch.stack([view.camera.centre for view in given.scene.train]).double()
        axes = Ground.under(centres, cloud.xyz).axes
        kept = one_per_cell((cloud.xyz.double() @ axes.T).numpy(), self.cell)
        if len(kept) < 4:
            raise BadInput(f"{len(kept)} cells have sparse points, which is too few; lower method.cell")
        vertices = cloud.xyz[torch.from_numpy(kept)].double()
        flat = (vertices @ axes.T).numpy()[:, :2]
        faces = facing(vertices.numpy(), Delaunay(flat).simplices, centres.mean(0).numpy())
        colors = cloud.rgb[torch.from_numpy(kept)].numpy()
        return Reconstruction(
            mesh=Mesh(vertices.float().numpy(), faces.astype(np.int32), colors), facts={"points": len(kept)}
        )


def one_per_cell(places: np.ndarray, cell: float) -> np.ndarray:
    """Rows of the point of middle height in each cell; `places` are (P, 3), the height last."""
    cells = np.floor(places[:, :2] / cell).astype(np.int64)
    _, which = np.unique(cells, axis=0, return_inverse=True)
    which = which.reshape(-1)
    order = np.lexsort((places[:, 2], which))
    starts = np.flatnonzero(np.diff(which[order], prepend=-1))
    counts = np.diff(np.append(starts, len(order)))
    return order[starts + counts // 2]


def facing(vertices: np.ndarray, faces: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """(F, 3) the triangles, each counter-clockwise as seen from `eye`, without those of no area."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    normals = np.cross(b - a, c - a)
    away = ((eye - a) * normals).sum(1) < 0
    turned = np.where(away[:, None], faces[:, ::-1], faces)
    return turned[np.linalg.norm(normals, axis=1) > 0]
