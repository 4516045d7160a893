"""The mesh in the loop (MILo, Guédon et al. 2025): made from the Gaussians in a step, drawn, and compared with them.

1. Some steps before, depth maps of the Gaussians, those of the views of the steps, are fused at the pivots.
2. Every so many steps, pivots are triangulated (Delaunay); in between, their positions follow the Gaussians.
3. In each step, marching tetrahedra give a mesh whose vertices are differentiable in positions and values of the
   pivots; its depth and normals in the view of the step, and those of the Gaussians, are pulled towards each other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import softplus
from torch.utils.weak import WeakTensorKeyDictionary

from surfkit.plugin import (
    BadInput,
    Edit,
    Interval,
    Maps,
    Points,
    Prune,
    Regularizer,
    RegularizerInput,
    Splats,
    Step,
    Steps,
    require_within,
)
from surfkit_milo.mesh_maps import draw_mesh
from surfkit_milo.pivots import PIVOTS, Boxes, crossings, require_pivots, tetrahedra

SUM, COUNT, NEAR = "milo/sum", "milo/count", "milo/near"
"""Columns: sum of the signed distances of each pivot from depth maps, their number, and in how many of them the centre
lay on the surface. Those of earlier intervals count half as much with each refresh."""
CHOSEN, USED, PLACES, DUE = "milo/chosen", "milo/used", "milo/places", "milo/due"
"""Columns: spread of the boxes of Gaussians that are to have pivots, 0 for others; that of those which are
triangulated; where their pivots were then; and the step in which `HandOut` is to give them values."""
SLOPE = 2.0
"""Occupancy is sigmoid(-2 v) of a value v: at the surface its slope is that of (1 - v) / 2."""
BEHIND = 1e-3
"""Weight of a view in which a pivot is farther behind the surface than distances reach: one that sees more decides."""
SOLID = 0.5
"""Pixels with less alpha show no surface."""

_TETRAHEDRA = WeakTensorKeyDictionary()
"""By the column USED of a set of points, the tetrahedra, which follow from USED and PLACES: nothing of them is lost."""


@dataclass(frozen=True)
class MeshInTheLoop(Regularizer):
    """Depth and normals of the mesh of the Gaussians against those of the Gaussians, both ways (MILo, sections 4.2 and
    4.3). Needs primitive:pivoted and prune.N:pivot-values."""

    depth: float = 0.05
    """Weight of log(1 + difference of depths), in scene extents."""

    normal: float = 0.05
    """Weight of 1 - |cos| of the angle between the normals."""

    inside: float = 0.005
    """Weight of the cross entropy of the occupancies of centres that are not inside, as they are to be."""

    labels: float = 0.005
    """Weight of the cross entropy of the occupancies of pivots that are not on the side where the fused depth has
    them."""

    watch: Steps = 5_000
    """Steps before depth maps are fused at the pivots."""

    start: Steps = 8_000
    """Steps without the mesh."""

    until: Steps = 18_000
    """Last step with the mesh."""

    refresh: Interval = 500
    """Steps between Delaunay triangulations."""

    limit: int = 600_000
    """Maximum number of Gaussians with pivots; of more, some are drawn by how often they were on the surface, and their
    boxes enlarged by the third root of all to those drawn."""

    faint: float = 0.05
    """Minimum opacity of Gaussians that get pivots."""

    truncation: float = 0.002
    """Signed distances are cut here, in scene extents, or at the shortest side of the box where that is longer. Pivots
    farther behind the depth of all views are inside, at this distance; those outside all views are unknown, and their
    Gaussians get no pivots."""

    longest: float = 1.0
    """Maximum length of an edge that the surface crosses, as a multiple of the half diagonals of the boxes at its ends,
    added up; 0 sets no limit."""

    surface: Literal["median", "expected"] = "median"
    """Which rendered depth is that of the Gaussians."""

    def __post_init__(self) -> None:
        require_within(dict.fromkeys(("depth", "normal", "inside", "labels", "longest"), (0, 1e6)), self)
        require_within({"watch": (0, 2**31), "start": (0, 2**31), "until": (0, 2**31), "refresh": (1, 2**31)}, self)
        require_within({"limit": (1, 2**24), "faint": (0, 1), "truncation": (1e-9, 1e6)}, self)
        if not self.watch <= self.start <= self.until:
            raise BadInput(
                f"mesh-in-the-loop: watch {self.watch}, start {self.start}, until {self.until} must not fall"
            )

    def weight_at(self, index: int, steps: int) -> float:
        """See `Regularizer.weight_at`; the terms have weights of their own."""
        return float(self.watch < index <= self.until)

    @property
    def reads(self) -> tuple[str, ...]:
        """See `Regularizer.reads`."""
        return ("alpha", "normal", "median" if self.surface == "median" else "depth")

    def __call__(self, splats: Splats) -> Tensor:
        """The part for which no view is needed: centres are inside."""
        require_pivots(splats, "regularizers.KEY:mesh-in-the-loop")
        return self.inside * _mean(wrong(SLOPE * splats.extra["occupancies"][:, 0]), splats.extra["spread"] > 0)

    def with_maps(self, splats: Splats, given: RegularizerInput) -> Tensor | None:
        """See `Regularizer.with_maps`: what differs between the mesh and the Gaussians in the view of the step."""
        require_pivots(splats, "regularizers.KEY:mesh-in-the-loop")
        used = given.stat(USED)
        if len(used) != len(splats):
            raise BadInput("mesh-in-the-loop needs all points in each step; choose pretrain.optimizer:adam")
        if given.index <= self.start or not used.any():
            return None
        if (splats.extra["spread"][used > 0] == 0).any():
            raise BadInput("mesh-in-the-loop: pivots have got no values; add pretrain.prune.0:pivot-values")
        boxes = Boxes.of(splats, used, used.nonzero()[:, 0]).double()
        mesh = draw_mesh(boxes, crossings(triangulated(given), boxes, self.longest), given.target.view.camera)
        depth, there = self.drawn(given.maps)
        counts = (there if given.target.mask is None else there & given.target.mask).flatten()[mesh.pixels]
        apart = (mesh.depth - depth.flatten()[mesh.pixels]).abs().log1p()
        normal = torch.nn.functional.normalize(given.maps.need("normal").flatten(1).T[mesh.pixels].double(), dim=1)
        turned = 1 - (normal * mesh.normal).sum(1).abs()
        return (self.depth * _mean(apart, counts) + self.normal * _mean(turned, counts)).to(depth)

    def drawn(self, maps: Maps) -> tuple[Tensor, Tensor]:
        """(H, W) depth of the Gaussians, and where they have any."""
        depth = maps.need("median") if self.surface == "median" else maps.expected_depth()
        return depth, (maps.need("alpha").detach() > SOLID) & (depth.detach() > 0)

    def in_step(self, splats: Splats, given: RegularizerInput) -> Tensor:
        """See `Regularizer.in_step`: depth is fused, pivots are triangulated when that is due, and occupancies are held
        where centres and fused depth want them."""
        require_pivots(splats, "regularizers.KEY:mesh-in-the-loop")
        self.fuse(splats.detached(), given)
        total, count = given.stat(SUM, PIVOTS), given.stat(COUNT, PIVOTS)
        has = splats.extra["spread"] > 0
        side = SLOPE * splats.extra["occupancies"] * torch.where(total > 0, -1.0, 1.0)  # of logits that are to fall
        labels = self.labels * _mean(wrong(side), has[:, None] & (count > 0) & (total != 0))
        term = self(splats) + labels
        if given.index >= self.start - self.refresh and (given.index - self.start) % self.refresh == 0:
            self.triangulate(splats.detached(), given)
        return term

    @torch.no_grad()
    def fuse(self, splats: Splats, given: RegularizerInput) -> None:
        """Add the depth of the view to the pivots that it sees: the signed distance along the axis of the camera."""
        chosen, near = given.stat(CHOSEN), given.stat(NEAR)
        rows = (given.seen & (splats.opacities >= self.faint)).nonzero()[:, 0]
        boxes = Boxes.of(splats, torch.where(chosen > 0, chosen, 1.0), rows)
        x, y, z = given.target.view.camera.project(boxes.places().reshape(-1, 3)).unbind(1)
        depth, there = self.drawn(given.maps)
        there = there if given.target.mask is None else there & given.target.mask
        height, width = depth.shape
        shown = (z > 0) & (x >= 0) & (y >= 0) & (x < width) & (y < height)
        at = torch.where(shown, y.floor() * width + x.floor(), 0.0).long()
        distance = (depth.flatten()[at] - z).view(-1, PIVOTS)
        cut = self.cut(boxes)
        sees = (shown & there.flatten()[at]).view(-1, PIVOTS)
        weight = torch.where(distance > -cut, 1.0, BEHIND) * sees
        given.stat(SUM, PIVOTS).index_add_(0, rows, (weight * distance.clamp(-cut, cut)).to(near))
        given.stat(COUNT, PIVOTS).index_add_(0, rows, weight.to(near))
        near.index_add_(0, rows, (sees[:, 0] & (distance[:, 0].abs() < cut[:, 0])).to(near))

    def cut(self, boxes: Boxes) -> Tensor:
        """(N, 1) where signed distances at the pivots of boxes are cut."""
        return 2 * boxes.half.detach().amin(1, keepdim=True).clamp_min(self.truncation / 2)

    @torch.no_grad()
    def triangulate(self, splats: Splats, given: RegularizerInput) -> None:
        """Choose Gaussians, give pivots to those of the chosen that were on the surface, and note where all pivots
        are."""
        chosen, used, near = given.stat(CHOSEN), given.stat(USED), given.stat(NEAR)
        total, count, spread = given.stat(SUM, PIVOTS), given.stat(COUNT, PIVOTS), splats.extra["spread"]
        chosen.copy_(torch.where(spread > 0, spread, chosen))
        self.choose(given)
        used.copy_(torch.where((spread > 0) | (count > 0).all(1) & (near > 0), chosen, 0.0))
        given.stat(PLACES, PIVOTS, 3).copy_(Boxes.of(splats, used).places())
        given.stat(DUE).fill_(given.index)
        for column in (total, count, near):
            column.mul_(0.5)
        _TETRAHEDRA.pop(used, None)

    def choose(self, given: RegularizerInput) -> None:
        """Let more of the Gaussians that were on the surface have pivots, as many as may."""
        chosen, near = given.stat(CHOSEN), given.stat(NEAR)
        free = ((chosen == 0) & (near > 0)).nonzero()[:, 0]
        room = self.limit - int((chosen > 0).sum())
        if len(free) <= room:
            chosen[free] = 1.0
        elif room > 0:
            draw = torch.rand(len(free), generator=torch.Generator().manual_seed(given.target.seed))
            order = (-draw.clamp_min(1e-12).log() / near[free].cpu()).argsort(stable=True)  # drawn by `near`
            rows = free[order[:room].to(free.device)]
            chosen[rows] = ((len(free) + self.limit - room) / self.limit) ** (1 / 3)
            for name in (SUM, COUNT):  # these are of smaller boxes
                given.stat(name, PIVOTS)[rows] = 0.0


def triangulated(given: RegularizerInput) -> np.ndarray:
    """(T, 4) Delaunay tetrahedra of the pivots in use, as they were at the last refresh."""
    used = given.stat(USED)
    if used not in _TETRAHEDRA:
        _TETRAHEDRA[used] = tetrahedra(given.stat(PLACES, PIVOTS, 3)[used > 0].view(-1, 3))
    return _TETRAHEDRA[used]


def wrong(logits: Tensor) -> Tensor:
    """Cross entropy of occupancies, of any shape, whose logit is to be below 0, as far as it is above that of a half.

    On the right side it is 0: Adam, which knows no small gradients, would else move values that no view corrects away
    from the distances that they are.
    """
    return (softplus(logits) - math.log(2)).clamp_min(0)


def _mean(values: Tensor, counts: Tensor) -> Tensor:
    """Mean of values (K,) or (N, 9) where they count, a mask that fits; 0 where none does."""
    return torch.where(counts, values, 0.0).sum() / counts.expand_as(values).sum().clamp_min(1)


@dataclass(frozen=True)
class PivotValues(Prune):
    """Give Gaussians that have got pivots in a step the values that fused depth has there, for
    regularizer:mesh-in-the-loop; removes none."""

    def edit(self, points: Points, step: Step) -> Edit | None:
        """The values, after a step that has triangulated; those that are there already stay."""
        if not len(points) or float(points.stat(DUE).amax()) != step.index:
            return None
        used, spread = points.stat(USED), points.params["spread"]
        total, count = points.stat(SUM, PIVOTS), points.stat(COUNT, PIVOTS)
        new = (used > 0) & (spread == 0)
        boxes = Boxes.of(step.splats, torch.where(used > 0, used, 1.0))
        begun = total / count.clamp_min(1e-9) / boxes.sizes.clamp_min(1e-12)[:, None]
        begun = torch.where(begun == 0, 1e-6, begun)
        values = {
            "spread": torch.where(new, used, spread),
            "occupancies": torch.where(new[:, None], begun, points.params["occupancies"]),
        }
        return Edit(values=values)
