"""Splats as raw parameters, with what it takes to draw them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

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


DrawnAs = Literal["auto", "3dgs", "antialias", "mip-splatting", "gof"]
"""How ellipsoids of other programs are drawn, which few files say: with the blur of 3DGS; with it made up for, as
gsplat can; likewise with the smaller blur of Mip-Splatting; along rays, as Gaussian Opacity Fields does."""
FORMS: dict[DrawnAs, dict[str, Any]] = {
    "3dgs": {},
    "antialias": {"antialias": True},
    "mip-splatting": {"antialias": True, "dilation": 0.1},
    "gof": {"geometry": "ray"},
}
"""Fields of `Gaussian3D` by how its splats are drawn."""


def primitive_of(table: SplatTable, drawn_as: DrawnAs = "auto") -> Primitive:
    """What the splats of a file are.

    Args:
        table: The splats.
        drawn_as: How ellipsoids are drawn; auto for what the file says, and as 3DGS where it says nothing.
    """
    if table.kind == "surfel":
        return Surfel2D(sh_degree=table.sh_degree)
    form = {"antialias": table.antialias} if drawn_as == "auto" else FORMS[drawn_as]
    return Gaussian3D(sh_degree=table.sh_degree, **form)
