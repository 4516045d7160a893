"""Fusion without pixels that are seen at a grazing angle."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from surfkit.plugin import TSDF, BadInput, Camera, Maps, Mesh, Mesher, MeshInput, View


@dataclass(frozen=True)
class MaxAngleTSDF(Mesher):
    """Fuse depth as mesh:tsdf does, but of no pixel that sees its surface at a grazing angle (PGSR)."""

    angle: float = 80.0
    """Largest angle between the ray and the rendered normal, degrees."""

    fusion: TSDF = field(default_factory=TSDF)
    """How the depth maps are fused."""

    def __post_init__(self) -> None:
        if not 0 < self.angle <= 90:
            raise BadInput(f"mesh.angle is {self.angle:g}; give more than 0 and at most 90 degrees")

    @property
    def needs_prior(self) -> bool:
        """See `Mesher.needs_prior`."""
        return self.fusion.needs_prior

    def mesh(self, subject: MeshInput) -> Mesh:
        """See `Mesher.mesh`."""

        def draw(view: View) -> Maps:
            return within(subject.draw(view), view.camera, self.angle)

        return self.fusion.mesh(replace(subject, draw=draw, draw_of=None))


def within(maps: Maps, camera: Camera, angle: float) -> Maps:
    """The maps without depth where the surface is seen at a larger angle than `angle`, degrees, or has no normal."""
    if maps.normal is None:
        return maps
    rays = camera.rays(maps.normal.dtype).to(maps.normal.device)
    along = -(maps.normal * rays).sum(0)
    length = (maps.normal.square().sum(0) * rays.square().sum(0)).sqrt()
    kept = (length > 0) & (along >= math.cos(math.radians(angle)) * length)

    def cut(depth: Tensor | None) -> Tensor | None:
        return None if depth is None else torch.where(kept, depth, 0.0)

    return replace(maps, depth=cut(maps.depth), median=cut(maps.median))
