"""Flat discs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch

from surfkit.primitives.base import Primitive, harmonics
from surfkit.primitives.columns import Column
from surfkit.primitives.init import facing, seeds
from surfkit.primitives.points import Columns
from surfkit.primitives.smoothing import Smoothable
from surfkit.raster.api import Splats
from surfkit.scene.scene import SparsePoints


@dataclass(frozen=True)
class Surfel2D(Smoothable, Primitive):
    """Flat discs with exact ray intersection: clean surfaces (2DGS, Huang et al. 2024)."""

    divides: ClassVar[bool] = True

    def columns(self) -> dict[str, Column]:
        """The standard ones, and the sampling intervals if scales are smoothed."""
        return self.smoothable_columns(2)

    def init(self, cloud: SparsePoints, generator: torch.Generator) -> Columns:
        """Discs facing along the cloud's normals, or any way when it has none."""
        params = seeds(self.columns(), cloud)
        anyhow = torch.randn(len(cloud.xyz), 4, generator=generator)  # uniform over all rotations
        quats = anyhow if cloud.normals is None else facing(cloud.normals)
        return params | {"quats": quats} | self.unobserved(len(quats))

    def activate(self, params: Columns, degree: int) -> Splats:
        """Surfels."""
        scales, opacities = self.filtered(params)
        return Splats(
            kind="surfel",
            means=params["means"],
            quats=params["quats"],
            scales=scales,
            opacities=opacities,
            sh0=params["sh0"],
            sh_rest=harmonics(params, degree),
        )
