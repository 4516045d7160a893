"""A primitive and a rasterizer as one: what draws the splats of the primitive."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.registry import kebab
from surfkit.primitives.base import Primitive
from surfkit.raster.api import Maps, Render, Splats
from surfkit.raster.base import Rasterizer
from surfkit.scene.camera import Camera


@dataclass(frozen=True)
class PrimitiveRasterizer(Rasterizer):
    """Draws as the primitive wants it, by means of a rasterizer."""

    primitive: Primitive
    inner: Rasterizer

    def title(self) -> str:
        """See `Rasterizer.title`."""
        return self.inner.title()

    def where(self) -> torch.device:
        """See `Rasterizer.where`."""
        return self.inner.where()

    def render(
        self, splats: Splats, camera: Camera, near: float, geometry: bool = True, distortion: bool = True
    ) -> Render:
        """See `Primitive.render`."""
        return self.primitive.render(splats, camera, self.inner, near, geometry, distortion)

    def contribution(
        self, splats: Splats, camera: Camera, near: float, alpha_power: float, transmittance_power: float
    ) -> tuple[Tensor, Tensor]:
        """See `Rasterizer.contribution`."""
        return self.primitive.contribution(splats, camera, self.inner, near, alpha_power, transmittance_power)

    def leading(self, splats: Splats, camera: Camera, near: float) -> Tensor:
        """See `Rasterizer.leading`."""
        return self.primitive.leading(splats, camera, self.inner, near)

    def opacity_before(self, splats: Splats, camera: Camera, near: float, points: Tensor) -> Tensor:
        """See `Rasterizer.opacity_before`."""
        return self.primitive.opacity_before(splats, camera, self.inner, near, points)


def refuse_wrong_maps(
    primitive: Primitive, maps: Maps, camera: Camera, read_by: Mapping[str, str] | None = None
) -> None:
    """BadInput for maps that a `render` of the primitive's own leaves out, or gives in another size than the view's.

    Args:
        primitive: What drew.
        maps: What it drew; colour and alpha are always wanted.
        camera: Of the view.
        read_by: By the name of a map that is read, the path of the term that reads it, such as losses.normal.
    """
    size, present, who = (
        (camera.height, camera.width),
        maps.present(),
        f"primitive {kebab(type(primitive).__name__)}: its render",
    )
    for name in ("color", "alpha"):
        if name not in present:
            raise BadInput(f"{who} gives no {name}, which every view needs; see `surfkit.raster.api.Maps`")
    for name, path in (read_by or {}).items():
        if name not in present:
            raise BadInput(
                f"{who} gives no {name}, which {path} reads; leave that out with {path}:none, or let the render draw "
                "that map"
            )
    for name, value in present.items():
        wanted = (3, *size) if name in ("color", "normal") else size
        if value.shape != wanted:
            raise BadInput(
                f"{who} gives {name} of shape {tuple(value.shape)} for a view of {wanted}; see "
                "`surfkit.raster.api.Maps`"
            )


def drawn_by(primitive: Primitive, rasterizer: Rasterizer) -> Rasterizer:
    """What draws the splats of a primitive: `rasterizer`, through the primitive where that draws in its own way."""
    if isinstance(rasterizer, PrimitiveRasterizer):
        rasterizer = rasterizer.inner
    return PrimitiveRasterizer(primitive, rasterizer) if draws_itself(primitive) else rasterizer


def draws_itself(primitive: Primitive) -> bool:
    """Whether a primitive draws its splats in its own way."""
    own, ways = type(primitive), ("render", "contribution", "leading", "opacity_before")
    return any(getattr(own, name) is not getattr(Primitive, name) for name in ways)
