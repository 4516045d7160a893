"""Splats as raw parameters, with what it takes to draw them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

from torch import Tensor

from surfkit.io.splats.splat_table import SplatTable
from surfkit.primitives.base import Primitive
from surfkit.primitives.gaussian3d import Gaussian3D
from surfkit.primitives.points import Columns
from surfkit.primitives.surfel2d import Surfel2D
from surfkit.raster.api import Splats

DEFAULT_NEAR = 0.005
"""Nothing nearer to a camera is drawn, local units, where a method says nothing else."""


@dataclass(frozen=True)
class SplatModel:
    """Splats, as the raw parameters of a primitive.

    Attributes:
        primitive: What the parameters are of.
        params: Raw columns of N points in the local frame, and the shared ones, as `Primitive.init` gives them.
        sh_degree: Of the spherical harmonics in use.
        near: Nothing nearer to a camera is drawn; local units.
    """

    primitive: Primitive
    params: Columns
    sh_degree: int = 0
    near: float = DEFAULT_NEAR

    def __len__(self) -> int:
        return len(self.params["means"])

    @cached_property
    def splats(self) -> Splats:
        """Activated values."""
        return self.primitive.activate(self.params, self.sh_degree)

    def take(self, rows: Tensor | slice) -> SplatModel:
        """The points of a mask, of indices or of a slice, with the shared parameters."""
        shared = self.primitive.shared()
        return replace(self, params={n: v if n in shared else v[rows] for n, v in self.params.items()})


def primitive_of(table: SplatTable) -> Primitive:
    """What the splats of a file are."""
    if table.kind == "surfel":
        return Surfel2D(sh_degree=table.sh_degree)
    return Gaussian3D(sh_degree=table.sh_degree, antialias=table.antialias)
