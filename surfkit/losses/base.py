"""What a loss is."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import torch
from torch import Tensor

from surfkit.core.registry import Component
from surfkit.io.datasets.depth_prior import DepthPrior
from surfkit.raster.api import Maps, Splats
from surfkit.scene.scene import View


@dataclass(frozen=True)
class Neighbour:
    """A second view of what a sample shows, from another side. All of it is constant.

    Attributes:
        view: The photograph's name and camera.
        photo: (3, H, W) float32 in [0, 1].
        maps: Rendered from the same splats as those of the sample: alpha, depth, median and normal.
        mask: (H, W) bool, False where the photograph is to be ignored, None where all of it counts. The trainer hides
            nothing here: losses leave such pixels out.
    """

    view: View
    photo: Tensor
    maps: Maps
    mask: Tensor | None = None


@dataclass(frozen=True)
class Target:
    """What a rendered view is compared with.

    Attributes:
        view: The photograph's name and camera.
        photo: (3, H, W) float32 in [0, 1].
        prior: What is known of the depth, of a photograph with a usable estimate and for losses that need one.
        mask: (H, W) bool, False where the photograph is to be ignored; None where all of it counts. The trainer sees
            to it (`ignoring`) that no loss learns from such pixels.
        neighbour: A second view, for losses that need one; None where no other photograph shows enough of the same.
        seed: Of random draws in this step, in [0, 2^63).
        index: The step, from 1, for losses that change as the training goes on; 0 before there is one.
    """

    view: View
    photo: Tensor
    prior: DepthPrior | None = None
    mask: Tensor | None = None
    neighbour: Neighbour | None = None
    seed: int = 0
    index: int = 0


def ignoring(maps: Maps, target: Target) -> tuple[Maps, Target]:
    """Maps and target without any gradient where the mask is False.

    There the photograph is what was rendered, no depth is known, and the maps are constants, so that no gradient
    reaches them through the windows of their neighbours either.
    """
    keep = target.mask
    if keep is None:
        return maps, target
    held = Maps(**{name: torch.where(keep, value, value.detach()) for name, value in maps.present().items()})
    prior = target.prior
    if prior is not None:
        names = ("inverse", "confidence", "normal")
        known: dict[str, Any] = {
            n: torch.where(keep, value, 0) for n in names if (value := getattr(prior, n)) is not None
        }
        prior = replace(prior, **known)
    return held, replace(target, photo=torch.where(keep, target.photo, held.need("color").detach()), prior=prior)


class Loss(Component):
    """A loss term.

    `reads` names the maps that the term needs; they are only rendered when a term with a weight reads them. Depth
    priors are only read when a term has `needs_prior`, and their normals when one has `needs_normals` too; a photograph
    may still be without one, and a data set without normals. `scale_band` says which of them are aligned well enough:
    the lowest and highest multiple of the median scale of all; None for a term that learns no depth. A second view is
    only chosen and rendered in steps in which a term with a weight has `needs_neighbour`, once for all of them. A term
    `of_structure` compares colours with those around them, and says little of how bright a photograph is as a whole:
    some appearance models (`spares_structure`) leave the colours that it sees as they are.
    """

    reads: ClassVar[tuple[str, ...]] = ("color",)
    needs_prior: ClassVar[bool] = False
    needs_neighbour: ClassVar[bool] = False
    needs_normals: ClassVar[bool] = False
    of_structure: ClassVar[bool] = False
    scale_band: tuple[float, float] | None = None

    @abstractmethod
    def weight_at(self, index: int, steps: int) -> float:
        """The term's weight in step `index` of 1..`steps`; 0 leaves the term out."""

    @abstractmethod
    def __call__(self, maps: Maps, target: Target) -> Tensor:
        """The unweighted loss, a scalar that is differentiable in the maps."""


@dataclass(frozen=True)
class RegularizerInput:
    """What a term on the points may know of a step beside the splats.

    Attributes:
        index: The step, 1 to `steps`.
        steps: Of the stage.
        target: The view of the step, its mask, and the seed of random draws.
        maps: What was rendered of that view; constant.
        seen: (N,) bool, the splat may touch a pixel of that view.
        stat: The column (N,) of this name that is kept with the points, zeros at first and for new points. A term may
            write to columns of its own: they follow the points through edits and are saved with them. Further sizes
            make a column (N, ...).
        params: Raw parameters, each (N, ...), and the shared ones; a term may be differentiable in them, too.
    """

    index: int
    steps: int
    target: Target
    maps: Maps
    seen: Tensor
    stat: Callable[..., Tensor]
    params: Mapping[str, Tensor] = field(default_factory=dict)


class Regularizer(Component):
    """A loss term on the points alone, not on what is rendered.

    One with `only_seen` is given the splats that may touch a pixel of the step's view, and not the others; there may be
    none.
    """

    only_seen: ClassVar[bool] = False

    @abstractmethod
    def weight_at(self, index: int, steps: int) -> float:
        """The term's weight in step `index` of 1..`steps`; 0 leaves the term out."""

    @abstractmethod
    def __call__(self, splats: Splats) -> Tensor:
        """The unweighted term, a scalar that is differentiable in the splats' tensors."""

    @property
    def reads(self) -> tuple[str, ...]:
        """Maps of the step's view that `in_step` looks at; only these are sure to be rendered."""
        return ()

    def in_step(self, splats: Splats, given: RegularizerInput) -> Tensor:
        """The unweighted term in a step of a stage, for terms that draw at random, look at the view, or remember
        something from step to step; by default that of the splats alone, or of those that are seen.
        """
        return self(splats.take(given.seen) if self.only_seen else splats)

    def with_maps(self, splats: Splats, given: RegularizerInput) -> Tensor | None:
        """A further part of the term, unweighted, that is differentiable in the splats and in `given.maps`: it moves
        the splats themselves, and by what was drawn of them. None for no such part, as by default.

        It is asked before `in_step`, and only reads its columns: a step whose memory gives out asks once more. The
        gradient that drives densification is without it.
        """
        return None
