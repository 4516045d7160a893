"""Ellipsoids."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from surfkit.primitives.base import Primitive, harmonics
from surfkit.primitives.columns import SIGMOID, Column, standard_columns
from surfkit.primitives.init import seeds
from surfkit.primitives.points import Columns
from surfkit.raster.api import Splats
from surfkit.scene.scene import Cloud


@dataclass(frozen=True)
class Gaussian3D(Primitive):
    """Ellipsoids: sharpest pictures, fuzzy surfaces (3DGS, Kerbl et al. 2023)."""

    antialias: bool = False
    """Dim splats smaller than a pixel by what the 0.3 px blur adds to them."""

    def columns(self) -> dict[str, Column]:
        """The standard ones."""
        return standard_columns(3, self.sh_degree)

    def init(self, cloud: Cloud, generator: torch.Generator) -> Columns:
        """Balls."""
        quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(cloud.xyz), 1)
        return seeds(self.columns(), cloud) | {"quats": quats}

    def activate(self, params: Columns, degree: int) -> Splats:
        """Gaussians."""
        return Splats(
            kind="gaussian",
            means=params["means"],
            quats=params["quats"],
            scales=params["scales"].exp(),
            opacities=SIGMOID.value(params["opacities"]),
            sh=harmonics(params, degree),
            antialias=self.antialias,
        )
