"""Meshes of Gaussians as stochastic solids (GGGS): of their field, and of their depth maps."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import torch

from surfkit.mesh.opacity_surface import OpacitySurface
from surfkit.mesh.solid_depth import solid_depth
from surfkit.plugin import TSDF, BadInput, Maps, Mesh, Mesher, MeshInput, View
from surfkit.primitives.drawing import PrimitiveRasterizer


@dataclass(frozen=True)
class SolidField(OpacitySurface):
    """Marching tetrahedra on the boxes of the splats, where half of the light reaches a place through stochastic solids
    from the view that sees it best (GGGS, after GOF).

    Splats other than Gaussians hide as for mesh:gof.
    """

    solid: ClassVar[bool] = True


@dataclass(frozen=True)
class SolidTSDF(Mesher):
    """Fuse depth as mesh:tsdf does, but where half of each ray is left open by stochastic solids (GGGS, eq. 10).

    It takes the place of the median depth; normals and colours are those that are drawn. Splats other than Gaussians
    keep their median depth.
    """

    fusion: TSDF = field(default_factory=TSDF)
    """How the depth maps are fused; its depth must be median."""

    def __post_init__(self) -> None:
        if self.fusion.depth != "median":
            raise BadInput(f"mesh.fusion.depth is {self.fusion.depth}; solids have a median depth alone")

    @property
    def needs_prior(self) -> bool:
        """See `Mesher.needs_prior`."""
        return self.fusion.needs_prior

    def mesh(self, subject: MeshInput) -> Mesh:
        """See `Mesher.mesh`."""
        splats = subject.splats
        if splats.kind != "gaussian" or isinstance(subject.rasterizer, PrimitiveRasterizer):
            return self.fusion.mesh(subject)

        def draw(view: View) -> Maps:
            with torch.no_grad():
                maps = subject.draw(view)
                median = maps.need("median")
                depth = solid_depth(splats, view.camera, subject.near, median)
            return replace(maps, median=depth.to(median))

        return self.fusion.mesh(replace(subject, draw=draw, draw_of=None))
