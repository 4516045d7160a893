"""Ellipsoids."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import torch

from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.primitives.base import Primitive, harmonics
from surfkit.primitives.columns import Column
from surfkit.primitives.init import facing, seeds
from surfkit.primitives.points import Columns
from surfkit.primitives.smoothing import Smoothable
from surfkit.raster.api import ALONG_RAYS, DILATION, Splats
from surfkit.scene.scene import SparsePoints

NO_NORMALS = (
    "primitive.first_thickness: the start knows no normals, so splats begin as balls; choose start:stereo, which knows "
    "them, or leave the option out"
)


@dataclass(frozen=True)
class Gaussian3D(Smoothable, Primitive):
    """Ellipsoids: sharpest pictures, fuzzy surfaces (3DGS, Kerbl et al. 2023)."""

    divides: ClassVar[bool] = True

    antialias: bool = False
    """Dim splats smaller than a pixel by what the dilation adds to them, as the 2D filter of Mip-Splatting does."""

    dilation: float = DILATION
    """Variance that is added to the footprint of a splat in an image, px^2: 0.3 in 3DGS, 0.1 in Mip-Splatting. Files of
    splats do not hold it: other programs add 0.3."""

    geometry: Literal["axis", "plane", "ray", "solid"] = "axis"
    """Normals and densities. axis: projected as in 3DGS, the shortest axis is the normal; plane: projected, the normal
    is that of the plane that gives the depth (RaDe-GS); ray: the largest density along each ray, not projected (GOF);
    solid: as ray, with the median depth of stochastic solids, for losses and meshers that read the median depth (GGGS).
    Files of splats do not hold it: other programs draw as axis."""

    first_thickness: float = 1.0
    """Third axis of a new splat, along the normal where the start knows one, as a share of the other two; 1 begins with
    balls."""

    def __post_init__(self) -> None:
        Smoothable.__post_init__(self)
        if not 0 < self.first_thickness <= 1:
            raise BadInput(f"primitive.first_thickness is {self.first_thickness:g}; it must be above 0 and at most 1")
        if not 0 < self.dilation < float("inf"):
            raise BadInput(f"primitive.dilation is {self.dilation:g}; it must be above 0")
        if self.antialias and self.geometry in ALONG_RAYS:
            raise BadInput(
                f"primitive.antialias makes up for the blur of the projection, and geometry {self.geometry} has none"
            )

    def columns(self) -> dict[str, Column]:
        """The standard ones, and the sampling intervals if scales are smoothed."""
        return self.smoothable_columns(3)

    def init(self, cloud: SparsePoints, generator: torch.Generator) -> Columns:
        """Balls, or thinner along the cloud's normals where it has some."""
        columns = self.columns()
        params = seeds(columns, cloud)
        quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(cloud.xyz), 1)
        if self.first_thickness < 1 and cloud.normals is None:
            emit(Warned(NO_NORMALS))
        elif self.first_thickness < 1 and cloud.normals is not None:
            quats, raw = facing(cloud.normals), params["scales"]
            thin = columns["scales"].activation.times(raw[:, 2:], self.first_thickness)
            params["scales"] = torch.cat([raw[:, :2], thin], 1)
        return params | {"quats": quats} | self.unobserved(len(quats))

    def activate(self, params: Columns, degree: int) -> Splats:
        """Gaussians."""
        scales, opacities = self.filtered(params)
        return Splats(
            kind="gaussian",
            means=params["means"],
            quats=params["quats"],
            scales=scales,
            opacities=opacities,
            sh0=params["sh0"],
            sh_rest=harmonics(params, degree),
            antialias=self.antialias,
            dilation=self.dilation,
            geometry=self.geometry,
        )
