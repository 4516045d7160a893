"""What decides which points are added and removed."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Protocol

import torch
from torch import Tensor

from surfkit.core.check import expect_tensor
from surfkit.core.lazy import Lazy
from surfkit.core.registry import Component, class_path, find
from surfkit.primitives.base import Primitive
from surfkit.primitives.edit import Edit
from surfkit.primitives.points import Points
from surfkit.raster.api import Derived, Splats


@dataclass(frozen=True)
class Contribution:
    """What one pass over all training views tells of each point.

    Attributes:
        mean: (N,) mean over the views of the point's mean alpha^a T^b over the pixels it is blended into; a view that
            does not see the point counts as 0 (CityGaussianV2, eq. average contribution).
        peak: (N,) the same of the view where it is largest.
        hits: (N,) int64, pixels of all views that the point is blended into.
        views: (N,) int64, views with such a pixel.
    """

    mean: Tensor
    peak: Tensor
    hits: Tensor
    views: Tensor


class Views(Protocol):
    """What a policy may ask about all training views; computed only when asked, and once for all who ask the same."""

    def __len__(self) -> int:
        """Training views, the length of an epoch."""

    def contributions(self, alpha_power: float = 0.5, transmittance_power: float = 0.5) -> Contribution:
        """The tally of alpha^a T^b."""

    def leading(self, at: Sequence[int] | None = None) -> Tensor:
        """(N,) int64, pixels of all views, or of those at the places `at`, in which each point both has the largest
        weight and is that of the median depth (`Rasterizer.leading`); computed each time that it is asked for."""

    def each(self, alpha_power: float, transmittance_power: float) -> Iterator[tuple[Tensor, Tensor]]:
        """Sum of alpha^a T^b, (N,), and count of pixels, (N,) int64, of one view after the other."""


@dataclass(frozen=True)
class ViewStatistics:
    """What a step tells of the points that it was for: with it, statistics cost what the view shows.

    Attributes:
        rows: (R,) int64, different points; None where the step was for all N, in their order.
        seen, grad_norm, radii, signed_norm: (R,) of these points, as in `Step`; of all others they are 0.
    """

    rows: Tensor | None
    seen: Tensor
    grad_norm: Tensor
    radii: Tensor
    signed_norm: Tensor | None = None

    def add(self, column: Tensor, values: Tensor) -> None:
        """Add (R,) values to a column (N,), in place."""
        if self.rows is None:
            column.add_(values)
        else:
            column.index_add_(0, self.rows, values.to(column.dtype))

    def raise_to(self, column: Tensor, values: Tensor) -> None:
        """Raise what is lower in a column (N,) to (R,) values, in place."""
        if self.rows is None:
            torch.maximum(column, values, out=column)
        else:
            column[self.rows] = torch.maximum(column[self.rows], values)


@dataclass(frozen=True)
class ComparedView:
    """A step's view as it was drawn, and its photograph.

    Attributes:
        color: (3, H, W) as drawn, in the light of the photograph.
        photo: (3, H, W) in [0, 1]; as drawn where the photograph is to be ignored.
        blended: (H, W) values of pixels to (R,): of each point of `Step.shown`, the sum over the pixels of the value
            times the weight alpha T that the point is blended with. Pixels to be ignored do not count. It costs a
            pass forward and one back, of splats in one colour.
    """

    color: Tensor
    photo: Tensor
    blended: Callable[[Tensor], Tensor]


@dataclass(frozen=True, kw_only=True)
class Step:
    """What policies know after one optimisation step; to be read within `watch` and `edit`.

    Values of all N points are made when they are first read. A policy that reads none of them in most steps, and keeps
    its statistics by `shown`, costs what the view shows.

    Attributes:
        index: Steps done, this one included.
        steps: Of the whole stage.
        seen: (N,) bool, the point may touch a pixel of this step's view.
        splats: The splats, N of them, detached; where the step was for the points in view, in the colours of degree 0.
        grad_norm: (N,) length of the densification signal, as `Gradients.signal`; 0 where not seen.
        radii: (N,) pixels; 0 where not seen.
        image_px: Longer side of this step's view, pixels.
        views: All training views.
        since_reset: Steps since opacities were last lowered (`Edit.max_opacity`); `index` if they never were.
        rates: Learning rates of this step by parameter, local units.
        seed: Differs from step to step and from run to run; for policies that draw.
        owns: (N, 3) positions to (N,) bool, whether points there are this block's own; None where all are.
        signed_norm: (N,) length of the signed gradient of all losses, whatever the densification signal is; 0 where not
            seen. The trainer always gives it.
        derived: What was drawn in place of the points, with its `grad_norm`, for a primitive that draws splats made of
            them (`DerivedRender`); None for others.
        in_view: See `shown`; None where the step was for all points.
        view: The view with its photograph, for policies that look at pixels; only within `watch`, and not of a
            primitive that draws itself (`Densify.needs_pixels`).
    """

    index: int
    steps: int
    seen: Lazy[Tensor] = Lazy()
    splats: Lazy[Splats] = Lazy()
    grad_norm: Lazy[Tensor] = Lazy()
    radii: Lazy[Tensor] = Lazy()
    image_px: int
    views: Views
    since_reset: int = 0
    rates: Mapping[str, float] = field(default_factory=dict)
    seed: int = 0
    owns: Callable[[Tensor], Tensor] | None = None
    signed_norm: Lazy[Tensor | None] = Lazy(None)
    derived: Derived | None = None
    in_view: ViewStatistics | None = None
    view: Lazy[ComparedView | None] = Lazy(None)

    @property
    def shown(self) -> ViewStatistics:
        """Of the points in view alone, where the step was for these; else of all."""
        return self.in_view or ViewStatistics(None, self.seen, self.grad_norm, self.radii, self.signed_norm)

    def may_be_densified(self) -> Tensor:
        """(N,) bool, the points that stand where this block owns them now; a trainer copies and splits no others."""
        means = self.splats.means
        if self.owns is None:
            return torch.ones_like(means[:, 0], dtype=torch.bool)
        return self.owns(means.cpu()).to(means.device)


class Policy(Component):
    """Decides how the set of points changes. It reads the points and a step, and writes only its own statistics."""

    divides: ClassVar[bool] = False
    """Whether it works where several processes train one model: `watch` treats each point by itself, and `edit`, which
    is asked in every process about all points, reads the step, `len(points)` and `points.stat(...)` and nothing else. A
    class says so itself, as another that is derived from it may do otherwise."""

    def watch(self, points: Points, step: Step) -> None:  # noqa: B027 (not every policy keeps statistics)
        """Accumulate statistics in `points.stat(...)`. Called after every step."""

    @abstractmethod
    def edit(self, points: Points, step: Step) -> Edit | None:
        """The change wanted now, or None. Called after `watch`; changes nothing itself."""


class Densify(Policy):
    """A policy that adds points where detail is missing."""

    def edits(self, steps: int) -> Sequence[int] | None:
        """The steps 1 to `steps` of a stage after which points may be added, in order; None where that is not known.

        Where there are none, a note says so before the run.
        """
        return None

    @property
    def needs_absolute(self) -> bool:
        """Whether it only works with a signal of absolute pixel gradients (`Signal.absolute`); others are refused."""
        return False

    @property
    def needs_pixels(self) -> bool:
        """Whether it reads `Step.view`; primitives that draw themselves, which cannot give it, are refused."""
        return False

    @property
    def needs_leading(self) -> bool:
        """Whether it asks for `Views.leading`; primitives without `tells_leading` are refused."""
        return False

    @property
    def most_points(self) -> int | None:
        """The number of points beyond which none is added; None where there is no such number."""
        return None

    def limited(self, points: int) -> Densify:
        """The same densifier, but one that adds no point beyond a number of `points`.

        It is used where memory has run out and where an ablation limits all rows alike, so the limit must hold. This
        default wraps the densifier; one with a limit of its own, which knows whom to prefer, lowers that.
        """
        limited: Any = find(Densify, "limited")
        return limited(self, points)


class Prune(Policy):
    """A policy that removes points."""

    def refuse_unfit(self, path: str, stage: Any, primitive: Primitive) -> None:  # noqa: B027 (most fit everywhere)
        """BadInput if the stage (`surfkit.plugin.Stage`) at a path in the recipe lacks what this works with, such as an
        optimizer of its own; asked before a run."""

    def edits(self, steps: int, views: int) -> Sequence[int] | None:
        """The steps 1 to `steps` of a stage with so many views after which points may be removed by what they are
        worth, in order; None where that is not known.

        Where there are none, a note says so before the run.
        """
        return None


class Filter(Component):
    """A condition that a point must meet to be densified."""

    @property
    def most_points(self) -> int | None:
        """As for `Densify.most_points`."""
        return None

    @abstractmethod
    def admits(self, step: Step, want: Tensor) -> Tensor:
        """(N,) bool, which points may be densified.

        Args:
            step: About the N points.
            want: (N,) how strongly each wants to; 0 for those that do not, and for those that are not admitted already.
        """


def admitted(filters: Sequence[Filter], step: Step, want: Tensor) -> Tensor:
    """(N,) bool, the points with a `want` above 0 that may be densified and pass one filter after the other."""
    want = want * step.may_be_densified()
    for condition in filters:
        admits = condition.admits(step, want)
        expect_tensor(f"{class_path(type(condition))}.admits", admits, ("bool",), (len(want),))
        want = want * admits
    return want > 0


class Signal(Component):
    """Which gradient drives densification."""

    divides: ClassVar[bool] = False
    """Whether it works where several processes train one model: with `terms` it is given the gradients of all points,
    without those of one process. A class says so itself."""

    absolute: ClassVar[bool] = False
    """Whether the pixels' shares of the chosen gradient are to be summed without their signs."""

    terms: tuple[str, ...] | None = None
    """Losses, by name, whose gradient is computed separately; None when only the total is needed."""

    @abstractmethod
    def combine(self, chosen: Tensor, total: Tensor) -> Tensor:
        """One (N, 2) gradient from the (N, 2) ones of the chosen losses and of all; both are 0 for unseen points."""
