"""Kinds of splats, and the points that hold their parameters."""

from collections.abc import Mapping

from surfkit.core.hooks import hookimpl
from surfkit.core.registry import Component
from surfkit.primitives.flat3d import Flat3D
from surfkit.primitives.gaussian3d import Gaussian3D
from surfkit.primitives.surfel2d import Surfel2D


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """The kinds of primitives, by name."""
    return {"surfel2d": Surfel2D, "gaussian3d": Gaussian3D, "flat3d": Flat3D}
