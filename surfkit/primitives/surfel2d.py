"""Flat discs."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from surfkit.primitives.base import Primitive, harmonics
from surfkit.primitives.columns import SIGMOID, Column, standard_columns
from surfkit.primitives.init import facing, seeds
from surfkit.primitives.points import Columns
from surfkit.raster.api import Splats
from surfkit.scene.scene import Cloud


@dataclass(frozen=True)
class Surfel2D(Primitive):
    """Flat discs with exact ray intersection: clean surfaces (2DGS, Huang et al. 2024)."""

    def columns(self) -> dict[str, Column]:
        """The standard ones."""
        return standard_columns(2, self.sh_degree)

    def init(self, cloud: Cloud, generator: torch.Generator) -> Columns:
        """Discs facing along the cloud's normals, or any way when it has none."""
        params = seeds(self.columns(), cloud)
        anyhow = torch.randn(len(cloud.xyz), 4, generator=generator)  # uniform over all rotations
        return params | {"quats": anyhow if cloud.normals is None else facing(cloud.normals)}

    def activate(self, params: Columns, degree: int) -> Splats:
        """Surfels."""
        return Splats(
            kind="surfel",
            means=params["means"],
            quats=params["quats"],
            scales=params["scales"].exp(),
            opacities=SIGMOID.value(params["opacities"]),
            sh=harmonics(params, degree),
        )
