"""The kind of component that estimates depth maps."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import torch
from torch import Tensor

from surfkit.core.registry import Component
from surfkit.scene.camera import Camera
from surfkit.scene.observations import Observations
from surfkit.scene.scene import View


@dataclass(frozen=True)
class KnownSurface:
    """What is known of the surface in a photograph before its depth is estimated, such as what a model draws.

    Attributes:
        inverse: (h, w) float32 inverse camera z, 1/local units; 0 where nothing is known.
        normal: (3, h, w) float32 unit normals in the camera's axes, towards the camera; 0 where none is known.
    """

    inverse: Tensor
    normal: Tensor


@dataclass(frozen=True)
class KnownSurfaces:
    """What an estimate goes on from.

    Attributes:
        see: Gives the surface of the view at a position, as a camera in its place sees it.
        key: Another one where the surfaces are others.
    """

    see: Callable[[int, Camera], KnownSurface]
    key: str


@dataclass(frozen=True)
class DepthInput:
    """The photographs and sparse points that depth is estimated from.

    Attributes:
        views: The photographs, with cameras in the local frame.
        observations: Where they show sparse points.
        device: Where to compute.
        work: A folder for what an interrupted estimate can go on from; it is deleted when all is done.
        in_one_light: Whether the photographs are known to be, as rendered ones are. Their colours at sparse points are
            not compared then, and the points need not be of the surface.
        known: Surfaces that an estimator which `continues` begins with; None for none.
    """

    views: Sequence[View]
    observations: Observations
    device: torch.device
    work: Path
    in_one_light: bool = False
    known: KnownSurfaces | None = None


@dataclass(frozen=True)
class Estimate:
    """The depth of one photograph.

    Attributes:
        at: Position of the view.
        inverse: (h, w) float32 inverse camera z, 1/local units if the estimator is `aligned`; 0 where there is none.
            None where the photograph gives nothing to work from.
        confidence: (h, w) float32 in [0, 1].
        normal: (3, h, w) float32 unit normals of the surface in the camera's axes, towards the camera; 0 where there is
            none. None from estimators that give no normals.
    """

    at: int
    inverse: Tensor | None
    confidence: Tensor | None
    normal: Tensor | None = None


class DepthEstimator(Component):
    """A way to estimate the depth of photographs with known cameras.

    `aligned` estimators give inverse depth in the units of the scene, others up to scale and offset. The ones that are
    `matched` compare photographs with one another, so they must not see those that are kept to measure with; those that
    are `oriented` give normals too, and one that `continues` begins with surfaces that are known. The `version` is
    raised when the same settings give other maps: what is kept of earlier ones is not used again. Maps do not depend on
    the masks of photographs: they are kept when masks change.
    """

    aligned: ClassVar[bool] = False
    matched: ClassVar[bool] = False
    oriented: ClassVar[bool] = False
    continues: ClassVar[bool] = False
    version: ClassVar[int] = 1

    @abstractmethod
    def estimate(self, given: DepthInput, wanted: Sequence[int]) -> Iterator[Estimate]:
        """Estimate the depth of the views at the positions `wanted`, one after the other, at any size."""

    def refuse_unfit(self, views: Sequence[View]) -> None:
        """BadInput if the settings do not fit the photographs; asked before anything is written or deleted."""
        return None

    def of_map(self, camera: Camera) -> Camera:
        """The camera of the depth map of a photograph, from that of the photograph; a map may be smaller. For what is
        told beforehand: the time of a map is foretold by its pixels."""
        return camera

    def files(self, views: Sequence[View]) -> tuple[Path, ...]:
        """Files that it reads beside the photographs; maps that were made from others are not used again."""
        return ()

    def refuse_missing(self) -> None:
        """BadInput if what it needs is not on this machine; asked before hours of other work."""
        return None

    def notice(self) -> str | None:
        """What a user should know before the results are used, such as a licence."""
        return None
