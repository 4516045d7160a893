"""A rasterizer."""

from __future__ import annotations

from typing import Any

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from surfkit.plugin import Camera, Gradients, Maps, Rasterizer, Render, Splats
from surfkit.raster.reference import Reference
from torch import Tensor


def converted(tensors: Mapping[str, Tensor], dtype: torch.dtype) -> dict[str, Tensor]:
    """The same tensors with numbers of another type."""
    return {name: value.to(dtype) for name, value in tensors.items()}


@dataclass(frozen=True)
class NewPart(Rasterizer):
    """Draw as the reference does, with numbers of 64 bits: slow, to see what the rounding of others changes."""

    device: ClassVar[str] = "cpu"
    rank: ClassVar[int] = -100  # below all others, so that it draws only where it is asked for by name

    def title(self) -> str:
        """See `Rasterizer.title`."""
        return f"new-part ({Reference().title()} in float64)"

    def render(
        self, splats: Splats, camera: Camera, near: float, geometry: bool = True, distortion: bool = True
    ) -> Render:
        """See `Rasterizer.render`."""
        return NewPartRender(Reference().render(_double(splats), camera, near, geometry, distortion), splats)

    def contribution(
        self, splats: Splats, camera: Camera, near: float, alpha_power: float, transmittance_power: float
    ) -> tuple[Tensor, Tensor]:
        """See `Rasterizer.contribution`."""
        total, count = Reference().contribution(_double(splats), camera, near, alpha_power, transmittance_power)
        return total.to(splats.means.dtype), count

    def opacity_before(self, splats: Splats, camera: Camera, near: float, points: Tensor) -> Tensor:
        """See `Rasterizer.opacity_before`."""
        return Reference().opacity_before(_double(splats), camera, near, points).to(splats.means.dtype)


class NewPartRender(Render):
    """A view drawn in float64, whose maps and gradients have the type of the splats."""

    def __init__(self, drawn: Render, splats: Splats) -> None:
        self._drawn, self._dtype = drawn, splats.means.dtype
        self.maps = Maps(**converted(drawn.maps.present(), self._dtype))
        self.seen, self.radii = drawn.seen, drawn.radii.to(self._dtype)

    def backward(
        self, total: Maps, chosen: Maps | None = None, absolute: bool = False, rows: int | None = None
    ) -> Gradients:
        """See `Render.backward`."""
        found = self._drawn.backward(total, chosen, absolute, rows)
        part = None if found.chosen is None else found.chosen.to(self._dtype)
        tensors: dict[str, Any] = converted({**found.tensors(), "signal": found.signal}, self._dtype)
        return replace(found, **tensors, chosen=part)


def _double(splats: Splats) -> Splats:
    return splats.with_named(converted(splats.named(), torch.float64))
