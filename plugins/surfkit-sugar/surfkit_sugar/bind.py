"""The refinement: a mesh is made, flat splats are bound to its triangles, and both are optimised together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal

import torch
from torch import Tensor
from torch.nn.functional import pad

from surfkit.mesh.simplify import require_simplification, simplify_to
from surfkit.plugin import (
    SIGMOID,
    BadInput,
    Columns,
    Mesh,
    Mesher,
    MeshInput,
    Primitive,
    Refine,
    SplatModel,
    Splats,
    Stage,
    View,
    choice,
)
from surfkit_sugar.bound import AdjacentNormals, MeshBound, sound
from surfkit_sugar.density import Ellipsoids, gathered, whitened
from surfkit_sugar.mesh import LevelSetPoisson
from surfkit_sugar.neighbours import nearest

ROWS = {1: 1, 3: 2, 6: 3}
"""Rows of circles in a triangle, by their number."""
NEIGHBOURS = 16
"""Splats of the model before that decide about the colour at a place: those with the nearest centres."""
CHUNK = 20_000
"""Places at a time: 20,000 x 16 neighbours x 48 coefficients are 61 MB."""


@dataclass(frozen=True)
class BindToMesh(Refine):
    """Make a mesh, put flat splats on its triangles in place of all others, and optimise them and the vertices together
    on the photographs (SuGaR, section 4.3)."""

    stage: Stage = field(
        default_factory=lambda: Stage(steps=15_000, regularizers={"normals": AdjacentNormals()}, densify=None)
    )
    """The optimisation."""

    mesher: Annotated[Mesher, choice(Mesher)] = LevelSetPoisson()
    """What makes the mesh, of the model before."""

    draws: Literal["gaussian", "surfel"] = "gaussian"
    """What lies on the triangles: ellipsoids with a third scale of almost 0, as published, or discs (2DGS)."""

    per_triangle: Literal[1, 3, 6] = 1
    """Splats on each triangle; published: 1 on meshes of 1,000,000 triangles, 6 on those of 200,000."""

    pixels: float = 4.0
    """Pixels of the training photographs for each splat, at least: meshes with more triangles are simplified. 0 sets no
    limit."""

    opacity: float = 0.9
    """Of each splat at first."""

    def __post_init__(self) -> None:
        if self.per_triangle not in ROWS or not 0 < self.opacity < 1 or self.pixels < 0:
            raise BadInput(
                f"bind-to-mesh has per_triangle {self.per_triangle}, opacity {self.opacity:g} and pixels "
                f"{self.pixels:g}; give 1, 3 or 6, a number between 0 and 1, and 0 or more"
            )

    def refuse_unfit(self, primitive: Primitive) -> None:
        """See `Refine.refuse_unfit`; meshes are simplified with fast-simplification."""
        require_simplification("bind-to-mesh")

    @property
    def meshers(self) -> tuple[Mesher, ...]:
        """See `Refine.meshers`."""
        return (self.mesher,)

    def primitive(self, primitive: Primitive) -> MeshBound:
        """See `Refine.primitive`."""
        return MeshBound(sh_degree=primitive.sh_degree, draws=self.draws)

    def begin(self, before: SplatModel, to_mesh: Callable[[Mesher], MeshInput]) -> Columns:
        """See `Refine.begin`: splats as large as the circles that fit into triangles, in the colours around them."""
        subject, like = to_mesh(self.mesher), before.splats.means
        made = self.simplified(self.mesher.mesh(subject), subject.views)
        vertices, faces = sound(
            torch.from_numpy(made.vertices).to(like), torch.from_numpy(made.faces).to(like.device, torch.int64)
        )
        if not len(faces):
            raise BadInput("bind-to-mesh: the mesh has no triangle that a splat can lie on; choose another mesher")
        primitive = self.primitive(before.primitive)
        begun = primitive.on(vertices, faces, ROWS[self.per_triangle])
        sh = colors_near(before.splats, begun["means"])
        rest = pad(sh[:, 1:], (0, 0, 0, (primitive.sh_degree + 1) ** 2 - sh.shape[1]))
        opacities = SIGMOID.inverse(torch.full((len(sh),), self.opacity, dtype=torch.float64)).to(like)
        return begun | {"opacities": opacities, "sh0": sh[:, :1].clone(), "sh_rest": rest}

    def simplified(self, mesh: Mesh, views: Sequence[View]) -> Mesh:
        """The mesh with so few triangles that there are `pixels` of the views for each splat."""
        if self.pixels == 0 or not len(mesh.faces):
            return mesh
        total = sum(view.camera.width * view.camera.height for view in views)
        return simplify_to(mesh, max(1, round(total / self.pixels / self.per_triangle)))


def colors_near(splats: Splats, places: Tensor) -> Tensor:
    """(M, K, 3) harmonics at (M, 3) places: the mean of those of near splats, weighted by their density there."""
    solid = Ellipsoids.of(splats)
    rows, table, sh = nearest(solid.means, NEIGHBOURS, places), solid.table().detach(), splats.sh.detach()
    found = []
    for some in torch.arange(len(places), device=places.device).split(CHUNK):
        near = gathered(table, rows[some]).unbind(0)
        square = sum(offset.square() for offset in whitened(near, places[some]))
        weights = torch.softmax(near[12].clamp_min(1e-30).log() - 0.5 * square, 1)
        found.append((weights[:, :, None, None] * sh[rows[some]]).sum(1))
    return torch.cat(found)
