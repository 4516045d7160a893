"""Ellipsoids pressed flat."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.primitives.base import Primitive, harmonics
from surfkit.primitives.columns import SIGMOID, Column, standard_columns
from surfkit.primitives.init import facing, seeds
from surfkit.primitives.points import Columns
from surfkit.raster.api import Splats
from surfkit.scene.scene import SparsePoints

NO_THICKNESS = 1e-20
"""Third scale of thickness 0, local units: no rounding shows its square beside those of the others, while
rasterizers, and files of splats, which hold logarithms, need one above 0."""


@dataclass(frozen=True)
class Flat3D(Primitive):
    """Ellipsoids whose third axis stays thin (the flat 3DGS of the CityGaussianV2 figure on convergence).

    Only two scales are trained. The third follows the smaller of them and has no gradient, so that it always is the
    thinnest axis and gives the normal.
    """

    divides: ClassVar[bool] = True

    thickness: float = 1e-3
    """Third scale as a share of the smaller of the other two; 0 makes planes, whose depth at a pixel is that of the
    plane to first order."""

    antialias: bool = False
    """Dim splats smaller than a pixel by what the 0.3 px blur adds to them."""

    def __post_init__(self) -> None:
        Primitive.__post_init__(self)
        if not 0 <= self.thickness < 1:
            raise BadInput(f"primitive.thickness is {self.thickness}; it must be 0 or more and below 1")

    def columns(self) -> dict[str, Column]:
        """The standard ones."""
        return standard_columns(2, self.sh_degree)

    def init(self, cloud: SparsePoints, generator: torch.Generator) -> Columns:
        """Thin discs facing along the cloud's normals, or any way when it has none."""
        params = seeds(self.columns(), cloud)
        anyhow = torch.randn(len(cloud.xyz), 4, generator=generator)
        return params | {"quats": anyhow if cloud.normals is None else facing(cloud.normals)}

    def activate(self, params: Columns, degree: int) -> Splats:
        """Gaussians."""
        return Splats(
            kind="gaussian",
            means=params["means"],
            quats=params["quats"],
            scales=self._three(params["scales"]),
            opacities=SIGMOID.value(params["opacities"]),
            sh0=params["sh0"],
            sh_rest=harmonics(params, degree),
            antialias=self.antialias,
        )

    def _three(self, raw: Tensor) -> Tensor:
        """(N, 3) scales from two raw ones."""
        two = raw.exp()
        third = self.thickness * two.detach().amin(-1, keepdim=True)
        return torch.cat([two, third.clamp_min(NO_THICKNESS)], dim=-1)
