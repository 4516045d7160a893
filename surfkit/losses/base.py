"""What a loss is."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from surfkit.core.registry import Component
from surfkit.raster.api import Maps, Splats
from surfkit.scene.depth_prior import DepthPrior
from surfkit.scene.scene import View


@dataclass(frozen=True)
class Sample:
    """What a rendered view is compared with.

    Attributes:
        view: The photograph's name and camera.
        photo: (3, H, W) float32 in [0, 1].
        prior: What is known of the depth, of a photograph with a usable estimate and for losses that need one.
    """

    view: View
    photo: Tensor
    prior: DepthPrior | None = None


class Loss(Component):
    """A term of the objective.

    `reads` names the maps that the term needs; they are only rendered when a term with a weight reads them. Depth
    priors are only read when a term has `needs_prior`; a photograph may still be without one.
    """

    reads: ClassVar[tuple[str, ...]] = ("color",)
    needs_prior: ClassVar[bool] = False

    @abstractmethod
    def weight_at(self, index: int, steps: int) -> float:
        """The term's weight in step `index` of 1..`steps`; 0 leaves the term out."""

    @abstractmethod
    def __call__(self, maps: Maps, sample: Sample) -> Tensor:
        """The unweighted loss, a scalar that is differentiable in the maps."""


class Regularizer(Component):
    """A term of the objective that looks at the points alone, not at what is rendered."""

    @abstractmethod
    def weight_at(self, index: int, steps: int) -> float:
        """The term's weight in step `index` of 1..`steps`; 0 leaves the term out."""

    @abstractmethod
    def __call__(self, splats: Splats) -> Tensor:
        """The unweighted term, a scalar that is differentiable in the splats' tensors."""
