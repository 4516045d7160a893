"""What a rasterizer is."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.registry import Component, kebab
from surfkit.raster.api import Render, Splats
from surfkit.raster.splat_boxes import SplatBoxes
from surfkit.scene.camera import Camera


@dataclass(frozen=True)
class Rasterizer(Component):
    """Draws splats on one kind of device. The device chooses among those that are registered; a recipe does not."""

    device: ClassVar[str] = "cpu"
    """Where it draws: "cpu" or "cuda"."""
    rank: ClassVar[int] = 0
    """Of those for one device, the one of the highest rank that can run is taken."""

    def missing(self) -> str | None:
        """Why it cannot run on this machine, and what to do, in one sentence; None if it can."""
        return None

    def where(self) -> torch.device:
        """The device that it draws on. Splats from another one are copied there; what is drawn lies where the splats
        lie."""
        return torch.device("cpu")

    @abstractmethod
    def title(self) -> str:
        """What run.json calls it, such as "cpu avx512"."""

    @abstractmethod
    def render(
        self, splats: Splats, camera: Camera, near: float, geometry: bool = True, distortion: bool = True
    ) -> Render:
        """Draw `splats`.

        Args:
            splats: Values are used, an autograd graph is not.
            camera: World is the splats' frame.
            near: Splats whose centre has z <= near are not drawn; depths are at least this. Local units.
            geometry: Also make depth, median and normal.
            distortion: And with them distortion, which costs the most.

        Raises:
            BadInput: A scale, opacity, mean or quaternion is not finite, or a shape is wrong.
        """

    def in_view(self, splats: Splats, camera: Camera, near: float) -> Tensor:
        """(N,) bool, the splats that may touch a pixel: all that `render` would see, and more; by default all.

        The picture is the same without the others. Opacities and colours are not looked at.
        """
        return torch.ones_like(splats.means[:, 0], dtype=torch.bool)

    def boxes_in_view(self, boxes: SplatBoxes, camera: Camera, near: float) -> Tensor | None:
        """(B,) bool, the boxes that may have a splat that `in_view` tells of, and more; None, the default, for all."""
        return None

    @abstractmethod
    def contribution(
        self, splats: Splats, camera: Camera, near: float, alpha_power: float, transmittance_power: float
    ) -> tuple[Tensor, Tensor]:
        """Sum and count, each (N,), of alpha^a T^b over the pixels that each splat is blended into.

        CityGaussianV2, eq. single-view contribution.
        """

    def leading(self, splats: Splats, camera: Camera, near: float) -> Tensor:
        """(N,) int64, the pixels in which a splat both has the largest weight alpha T, the first in depth order of
        equal ones, and is that of the median depth, as `Maps` defines it.

        MetroGS, section 4.2.2, eq. 5: S_i of one view.

        Raises:
            BadInput: By default, as a rasterizer of another package need not know.
        """
        raise BadInput(
            f"rasterizer {kebab(type(self).__name__)} does not tell which splats lead in a pixel, which a densifier "
            "asks for; choose another densifier, or give the rasterizer a `leading`"
        )

    @abstractmethod
    def opacity_before(self, splats: Splats, camera: Camera, near: float, points: Tensor) -> Tensor:
        """(P,) in [0, 1], what the splats hide of (P, 3) points of the world: the opacity field of one view (GOF).

        That is 1 - product of (1 - alpha) of the splats that the ray from the camera through the point meets no farther
        than the point. NaN where the point is outside the image or not beyond `near`.
        """
