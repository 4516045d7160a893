"""How anchors are added and removed: new ones in voxels whose Gaussians have high gradients, none that stay faint."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor

from surfkit.plugin import BadInput, Columns, Densify, Edit, NewPoints, Points, Step, StepCount, Steps
from surfkit.raster.autograd import summed_by_owner
from surfkit_octree.anchors import FULL
from surfkit_octree.levels import TABLE, LevelTable, centres, voxels

GRAD, SEEN, OPACITY, VIEWS = "anchors/grad", "anchors/seen", "anchors/opacity", "anchors/views"
SPREAD = 4
"""Voxels of one level grow by this factor from one size to the next (Scaffold-GS, section 3.3)."""


@dataclass(frozen=True)
class AnchorGrowth(Densify):
    """Add anchors in empty voxels where the gradients of Gaussians are high, of several sizes (Scaffold-GS) or of the
    levels of detail (Octree-GS), and drop anchors whose Gaussians stay faint. For primitive:anchors only."""

    threshold: float = 2e-4
    """Mean length of the gradient of a Gaussian above which its voxel gets an anchor, in units of half the image
    size."""

    level_rise: float = 0.2
    """From level to level the threshold grows by fork to the power of this (Octree-GS)."""

    sizes: int = 3
    """Sizes of voxels that are tried where there is one level of detail: each is a quarter of the one before, with
    twice its threshold; the last has the size of the level (Scaffold-GS)."""

    kept: float = 0.5
    """Share of the Gaussians above the threshold, drawn at random, that may add an anchor at one time."""

    start: Annotated[int, StepCount(floor=100, stretch=8.0)] = 1_500
    """Steps before the first edit; short runs keep at least 100, but no more than half of the way to `until`."""

    until: Steps = 25_000
    """Last step that adds or drops anchors."""

    every: Annotated[int, StepCount(floor=50, stretch=50.0)] = 100
    """Steps between edits; short runs keep at least 50, but no more than a fifth of the way to `until`."""

    shown: float = 0.8
    """An anchor is judged by its opacity when it was in this share of `every` views, and a Gaussian by its gradient
    when it was in half of that; until then what is known of them is kept from edit to edit."""

    min_opacity: float = 0.005
    """Drop anchors whose Gaussians had together, in the mean over views, less opacity than this."""

    progressive: Steps = 10_000
    """Steps in which training goes from the coarser half of the levels to all; 0 draws all levels from the start."""

    progressive_factor: float = 1.5
    """A level is trained for this many times the steps of the next finer one, before that is added."""

    extra_ratio: float = 0.25
    """Anchors with a mean gradient above this share of the threshold are drawn from farther away (Octree-GS)."""

    extra_step: float = 0.01
    """By how many levels more, at each edit."""

    def __post_init__(self) -> None:
        if self.every < 1 or self.sizes < 1:
            raise BadInput(f"densify: every is {self.every} and sizes {self.sizes}; both must be 1 or more")
        if not (0 < self.kept <= 1 and 0 < self.shown <= 1 and self.progressive_factor >= 1 and self.threshold > 0):
            raise BadInput(
                f"densify: kept is {self.kept:g} and shown {self.shown:g} (above 0, up to 1), progressive_factor "
                f"{self.progressive_factor:g} (1 or more), threshold {self.threshold:g} (above 0); these do not fit"
            )

    def edits(self, steps: int) -> range:
        """See `Densify.edits`."""
        return range((self.start // self.every + 1) * self.every, min(self.until, steps) + 1, self.every)

    def active(self, index: int, count: int) -> int:
        """How many of `count` levels are drawn after step `index`.

        The coarser half at first; then one more each time, all after `progressive` steps. The time before each is
        `progressive_factor` times that before the next.
        """
        first = max(1, count // 2)
        shares = [self.progressive_factor**-at for at in range(count - first)]
        ends = (self.progressive * sum(shares[: at + 1]) / sum(shares) for at in range(count - first))
        return first + sum(index >= end - 1e-6 for end in ends)

    def watch(self, points: Points, step: Step) -> None:
        """Sum gradients of Gaussians and opacities of anchors, until an edit has judged them."""
        if step.index > self.until:
            return
        derived, count = step.derived, _offsets(points)
        if derived is None or derived.grad_norm is None:
            return
        grad, seen = points.stat(GRAD, count), points.stat(SEEN, count)
        opacity, views = points.stat(OPACITY), points.stat(VIEWS)
        if self._due(step.index - 1):
            judged, known = self._judged(seen), self._known(views)
            for stat, mask in ((grad, judged), (seen, judged), (opacity, known), (views, known)):
                stat.masked_fill_(mask, 0)
        made = derived.splats.opacities
        slots = derived.owner * count + torch.arange(len(made), device=made.device) % count
        lit = (derived.seen & (made > 0)).to(grad)
        grad.view(-1).index_add_(0, slots, derived.grad_norm * lit)
        seen.view(-1).index_add_(0, slots, lit)
        opacity += summed_by_owner(made, derived.owner, len(opacity))
        views.index_add_(0, derived.owner[::count], torch.ones_like(made[::count]))

    def edit(self, points: Points, step: Step) -> Edit | None:
        """New anchors, drops and levels every so often; the levels that are drawn whenever they change."""
        _offsets(points)
        table = LevelTable.of(points.shared[TABLE])
        # a stage that goes on from a trained model keeps the levels that it had
        active, values = max(table.active, self.active(step.index, table.count)), {}
        if active != table.active:
            stored = points.shared[TABLE].clone()
            stored[2] = active
            values[TABLE] = stored
        if not self._due(step.index) or GRAD not in points.stats:
            return Edit(values=values) if values else None
        known, level = self._known(points.stat(VIEWS)), points.params["level"]
        mean = points.stat(GRAD) / points.stat(SEEN).clamp_min(1) * self._judged(points.stat(SEEN))
        if table.count > 1:
            eager = mean.amax(-1) >= self.extra_ratio * self._threshold(level, table)
            values["extra"] = points.params["extra"] + self.extra_step * eager
        faint = known & (points.stat(OPACITY) < self.min_opacity * points.stat(VIEWS))
        return Edit(drop=faint, new=self._grown(points, step, mean, table), values=values or None)

    def _grown(self, points: Points, step: Step, mean: Tensor, table: LevelTable) -> NewPoints | None:
        """The new anchors, by (N, k) mean gradients of Gaussians."""
        params, count = points.params, mean.shape[1]
        at = params["means"][:, None] + params["offsets"] * params["scales"][:, None, :3].exp()
        may = step.may_be_densified()[:, None]
        draw = torch.Generator().manual_seed(step.seed)
        places, levels, found = params["means"], params["level"], []
        for threshold, level, side in self._rounds(points, mean, table):
            lucky = (torch.rand(mean.shape, generator=draw) < self.kept).to(mean.device)
            rows = ((mean >= threshold) & lucky & may).reshape(-1).nonzero()[:, 0]
            new = grow(
                places, levels, at.reshape(-1, 3)[rows], level.reshape(-1)[rows], side, table, mean.view(-1)[rows]
            )
            parent = rows[new.best] // count
            asked = params["feature"][rows[new.rows] // count]
            feature = asked.new_full((len(new.best), asked.shape[1]), -math.inf)
            feature = feature.scatter_reduce(0, new.voxel[:, None].expand_as(asked), asked, "amax")
            found.append(_fresh(points, new, feature, parent))
            places = torch.cat([places, new.places.to(places)])
            levels = torch.cat([levels, new.level.to(levels)])
        whole = {name: torch.cat([each.params[name] for each in found]) for name in params}
        return NewPoints(whole, torch.cat([each.parent for each in found])) if len(whole["means"]) else None

    def _rounds(
        self, points: Points, mean: Tensor, table: LevelTable
    ) -> Iterator[tuple[Tensor | float, Tensor, float | None]]:
        """Threshold, (N, k) levels of new anchors, and the side of voxels if it is not that of the level."""
        level = points.params["level"][:, None].expand(mean.shape)
        if table.count == 1:
            for at in range(self.sizes):
                yield self.threshold * 2**at, level, table.voxel * SPREAD ** (self.sizes - 1 - at)
            return
        finer = (level + (mean >= self._threshold(level + 1, table))).clamp_max(table.drawn - 1)
        yield self._threshold(level, table), torch.maximum(finer, level), None

    def _threshold(self, level: Tensor, table: LevelTable) -> Tensor:
        return self.threshold * table.fork ** (self.level_rise * level)

    def _due(self, index: int) -> bool:
        return self.start < index <= self.until and index % self.every == 0

    def _judged(self, seen: Tensor) -> Tensor:
        """Gaussians that were seen often enough."""
        return seen >= max(1.0, 0.5 * self.shown * self.every)

    def _known(self, views: Tensor) -> Tensor:
        """Anchors that were in enough views."""
        return views >= max(1.0, self.shown * self.every)


@dataclass(frozen=True)
class Grown:
    """M voxels that get an anchor, and the R candidates in them.

    Attributes:
        places: (M, 3) float32 centres.
        level: (M,) int64.
        side: (M,) sides, local units.
        best: (M,) int64, the candidate of the highest gradient in each voxel, the first of equals.
        rows: (R,) int64, the candidates that lie in these voxels.
        voxel: (R,) int64, the voxel of each of them.
    """

    places: Tensor
    level: Tensor
    side: Tensor
    best: Tensor
    rows: Tensor
    voxel: Tensor


def grow(
    places: Tensor, levels: Tensor, at: Tensor, level: Tensor, side: float | None, table: LevelTable, gradient: Tensor
) -> Grown:
    """The voxels of candidates that hold no anchor of the level yet.

    Args:
        places: (N, 3) anchors that there are.
        levels: (N,) their levels.
        at: (C, 3) candidates.
        level: (C,) levels of the anchors that they ask for.
        side: Of the voxels; None for that of each level.
        table: Of the levels.
        gradient: (C,) of the candidates.
    """

    def keys(positions: Tensor, each: Tensor) -> Tensor:
        sides = table.side(each) if side is None else torch.full_like(each, side)
        return torch.cat([each.to(torch.int64)[:, None], voxels(positions, sides)], 1)

    both = torch.cat([keys(places, levels), keys(at, level)])
    unique, back = torch.unique(both, dim=0, return_inverse=True)
    taken = torch.zeros(len(unique), dtype=torch.bool, device=at.device)
    taken[back[: len(places)]] = True
    of = back[len(places) :]
    rows = (~taken[of]).nonzero()[:, 0]
    wanted, voxel = torch.unique(of[rows], return_inverse=True)
    order = gradient[rows].argsort(descending=True, stable=True)
    rank = torch.empty_like(order)
    rank[order] = torch.arange(len(order), device=order.device)
    best = torch.full_like(wanted, len(rows)).scatter_reduce(0, voxel, rank, "amin")
    sides = table.side(unique[wanted, 0]) if side is None else torch.full((len(wanted),), side, device=at.device)
    return Grown(centres(unique[wanted, 1:], sides), unique[wanted, 0], sides, rows[order[best]], rows, voxel)


def _fresh(points: Points, new: Grown, feature: Tensor, parent: Tensor) -> NewPoints:
    """Raw parameters of new anchors: the largest features of the anchors that asked for them, and offsets of 0."""
    made: Columns = {name: value.new_zeros(len(parent), *value.shape[1:]) for name, value in points.params.items()}
    made["means"], made["level"], made["feature"] = new.places.to(made["means"]), new.level.to(made["level"]), feature
    made["opacities"].fill_(FULL)
    made["scales"] += new.side.log()[:, None]
    return NewPoints(made, parent)


def _offsets(points: Points) -> int:
    """Gaussians of an anchor; BadInput for points that are no anchors."""
    if TABLE not in points.shared or "offsets" not in points.params:
        raise BadInput("densify: anchor-growth adds and drops anchors only; choose primitive:anchors, or densify:adc")
    return points.params["offsets"].shape[1]
