"""Meshes of Gaussians as stochastic solids (GGGS): of their field, and of their depth maps."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import torch

from surfkit.mesh.opacity_surface import OpacitySurface
from surfkit.plugin import TSDF, BadInput, Maps, Mesh, Mesher, MeshInput, View, Warned, emit
from surfkit.primitives.drawing import PrimitiveRasterizer


@dataclass(frozen=True)
class SolidField(OpacitySurface):
    """Marching tetrahedra on the boxes of the splats, where half of the light reaches a place through stochastic solids
    from the view that sees it best (GGGS, after GOF).

    Splats other than Gaussians hide as for mesh:gof, with a warning.
    """

    solid: ClassVar[bool] = True

    def mesh(self, subject: MeshInput) -> Mesh:
        """See `Mesher.mesh`."""
        if not are_solids(subject):
            emit(Warned(f"mesh:gggs: {subject.splats.kind} splats are no solids; they hide as for mesh:gof"))
        return super().mesh(subject)


@dataclass(frozen=True)
class SolidTSDF(Mesher):
    """Fuse depth as mesh:tsdf does, but where half of each ray is left open by stochastic solids (GGGS, eq. 10).

    Of a model of `primitive:gaussian3d` with `geometry solid` mesh:tsdf does the same. Of others it takes the place of
    the median depth; normals and colours are those that are drawn, and `facts` of the mesh tell the share of the pixels
    with a median depth in which none of solids was found. Splats other than Gaussians keep their median depth, with a
    warning.
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
        if not are_solids(subject):
            emit(Warned(f"mesh:gggs-tsdf: {subject.splats.kind} splats are no solids; their median depth is fused"))
            return self.fusion.mesh(subject)
        if subject.splats.geometry == "solid":  # the median depth that is drawn is this one
            return self.fusion.mesh(subject)
        solids = replace(subject.splats, geometry="solid", antialias=False)
        pixels = {"drawn": 0, "found": 0}

        def draw(view: View) -> Maps:
            with torch.no_grad():
                maps = subject.draw(view)
                drawn = subject.rasterizer.render(solids, view.camera, subject.near, distortion=False).maps
            median, depth = maps.need("median"), drawn.need("median")
            pixels["drawn"] += int((median > 0).sum())
            pixels["found"] += int(((depth > 0) & (median > 0)).sum())
            return replace(maps, median=depth.to(median))

        mesh = self.fusion.mesh(replace(subject, draw=draw, draw_of=None))
        lost = 1 - pixels["found"] / max(1, pixels["drawn"])
        return replace(mesh, facts={**mesh.facts, "pixels_without_solid_depth": lost})


def are_solids(subject: MeshInput) -> bool:
    """Whether the splats are Gaussians that a rasterizer draws, and not a primitive itself."""
    return subject.splats.kind == "gaussian" and not isinstance(subject.rasterizer, PrimitiveRasterizer)
