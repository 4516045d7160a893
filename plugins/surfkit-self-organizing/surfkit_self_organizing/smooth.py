"""Splats that are alike where they are neighbours in a grid (Morgenstern et al. 2024)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Annotated

import torch
from torch import Tensor
from torch.nn.functional import huber_loss, pad

from surfkit.plugin import SOG, BadInput, Regularizer, RegularizerInput, Splats, StepCount, Steps
from surfkit_self_organizing.attributes import attributes_of, grid_order

ROW, COLUMN = "self-organizing/row", "self-organizing/column"
"""Columns (N,): row and column in the grid, from 1; 0 for points that have no place yet."""
REACH = 3.0
"""Where the kernel of the blur ends, in standard deviations."""


@dataclass(frozen=True)
class SmoothGrid(Regularizer):
    """Attributes of points are near those around them in a grid, sorted anew at times (Self-Organizing Gaussians).

    From Morgenstern et al. ECCV 2024: Parallel Linear Assignment Sorting puts all points into a grid whose neighbours
    are alike; the term is the Huber loss between the grid of an attribute and that grid after a Gaussian blur, times
    the attribute's weight. Pictures of such grids take less space: `format:grid-sog` writes them.

    Points keep their places until they are sorted again. Those that an edit adds have none until then, and those that
    it drops leave empty places; neither has a part in the loss. The mean is over points, and differences of the
    components of an attribute add up.

    The paper's weights, blur and intervals were not at hand: the defaults here are ours, and the weight is one that
    cost little on the bundled example. More of it makes smaller files, and pictures that are less sharp.
    """

    weight: float = 0.3
    """Loss weight of all attributes together."""

    positions: float = 0.0
    """Weight of positions, in local units: the scene extent is 1."""

    colors: float = 1.0
    """Weight of the coefficients of base colours."""

    harmonics: float = 0.0
    """Weight of the other coefficients of spherical harmonics, which files of SOG hold in a palette, not in a grid."""

    scales: float = 1.0
    """Weight of the natural logarithms of scales."""

    rotations: float = 1.0
    """Weight of rotations, as unit quaternions whose largest component is positive."""

    opacities: float = 1.0
    """Weight of opacities, 0 to 1."""

    delta: float = 0.1
    """Difference of a component up to which the loss is quadratic, and linear from there on."""

    sigma: float = 1.0
    """Standard deviation of the blur, in places of the grid."""

    start: Steps = 0
    """Last step without this term; the points are sorted in the next one."""

    every: Annotated[int, StepCount(floor=50)] = 1_000
    """Steps from one sorting to the next; short runs keep at least 50."""

    def __post_init__(self) -> None:
        for name in ("weight", *self._weights()):
            if not 0 <= getattr(self, name) < math.inf:
                raise BadInput(
                    f"regularizer:smooth-grid: {name} is {getattr(self, name):g}; it must be 0 or more, and finite"
                )
        if not any(self._weights().values()):
            raise BadInput(
                f"regularizer:smooth-grid: all of {', '.join(self._weights())} are 0, so that nothing is smoothed; "
                f"give one of them more than 0, or leave this regularizer out"
            )
        for name in ("delta", "sigma"):
            if not 0 < getattr(self, name) < math.inf:
                raise BadInput(f"regularizer:smooth-grid: {name} is {getattr(self, name):g}; it must be above 0")
        if self.start < 0 or self.every < 1:
            raise BadInput(
                f"regularizer:smooth-grid: start {self.start}, every {self.every}; give 0 steps or more, and 1 or more"
            )

    def _weights(self) -> dict[str, float]:
        """By attribute."""
        other = ("weight", "delta", "sigma", "start", "every")
        return {field.name: getattr(self, field.name) for field in fields(self) if field.name not in other}

    def weight_at(self, index: int, steps: int) -> float:
        """See `Regularizer.weight_at`."""
        return self.weight if index > self.start else 0.0

    def __call__(self, splats: Splats) -> Tensor:
        """The term of splats that are sorted now."""
        row, column = places_of(splats, 0)
        return self._term(splats, row, column)

    def in_step(self, splats: Splats, given: RegularizerInput) -> Tensor:
        """See `Regularizer.in_step`; sorts where that is due."""
        row, column = given.stat(ROW), given.stat(COLUMN)
        if (given.index - self.start - 1) % self.every == 0:
            for kept, found in zip((row, column), places_of(splats, given.target.seed), strict=True):
                kept.copy_(found + 1)
        return self._term(splats, row.to(splats.means.device).long() - 1, column.to(splats.means.device).long() - 1)

    def _term(self, splats: Splats, row: Tensor, column: Tensor) -> Tensor:
        """The term, of points at (N,) rows and columns from 0; -1 for those without a place."""
        weights = {name: weight for name, weight in self._weights().items() if weight > 0}
        placed = (row >= 0).nonzero()[:, 0]
        if not len(placed):
            return splats.means.sum() * 0  # all points came after the last sorting
        row, column = row[placed], column[placed]
        found = {name: value[placed] for name, value in attributes_of(splats).items() if name in weights}
        return roughness(found, weights, row, column, self.delta, self.sigma)


def places_of(splats: Splats, seed: int) -> tuple[Tensor, Tensor]:
    """(N,) int64 rows and columns of splats that are sorted, from 0; BadInput if these are of another kind."""
    if splats.kind not in ("surfel", "gaussian"):
        raise BadInput(
            f"regularizer:smooth-grid: it smooths surfels and ellipsoids, and the primitive has splats of the kind "
            f"{splats.kind!r}; choose another primitive, or leave this regularizer out"
        )
    order = torch.from_numpy(grid_order(attributes_of(splats), seed)).to(splats.means.device)
    place = torch.empty_like(order)
    place[order] = torch.arange(len(order), device=order.device)
    width = SOG.picture_width(len(order))
    return place // width, place % width


def roughness(
    attributes: Mapping[str, Tensor],
    weights: Mapping[str, float],
    row: Tensor,
    column: Tensor,
    delta: float,
    sigma: float,
) -> Tensor:
    """Weighted Huber loss between grids and themselves after a blur, a scalar: the mean over points, of sums.

    Args:
        attributes: (M, D) by name.
        weights: Of each of them.
        row: (M,) int64 rows in the grid.
        column: (M,) int64 columns. No two points share a place.
        delta: Where the loss becomes linear.
        sigma: Standard deviation of the blur, in places.
    """
    width = int(column.max()) + 1
    places, place = (int(row.max()) + 1) * width, row * width + column
    values = torch.cat(
        [*attributes.values(), torch.ones_like(row, dtype=next(iter(attributes.values())).dtype)[:, None]], 1
    )
    grid = values.new_zeros(places, values.shape[1]).index_copy(0, place, values)
    blurred = blur(grid.view(-1, width, grid.shape[1]), sigma).view(places, -1).index_select(0, place)
    around = blurred[:, :-1] / blurred[:, -1:]
    factors = torch.cat([values.new_full((value.shape[1],), weights[name]) for name, value in attributes.items()])
    each = huber_loss(values[:, :-1], around, reduction="none", delta=delta)
    return (each * factors).sum(1).mean()


def blur(grid: Tensor, sigma: float) -> Tensor:
    """(H, W, C) a grid after a Gaussian filter, 0 beyond its border."""
    radius = max(1, math.ceil(REACH * sigma))
    kernel = [math.exp(-((at / sigma) ** 2) / 2) for at in range(-radius, radius + 1)]
    for axis, border in ((0, (0, 0, 0, 0, radius, radius)), (1, (0, 0, radius, radius))):
        wide, size = pad(grid, border), grid.shape[axis]
        grid = sum(tap / sum(kernel) * wide.narrow(axis, at, size) for at, tap in enumerate(kernel))  # type: ignore[assignment]
    return grid
