"""Points that are large and alone are split, whatever their gradients (MetroGS, Chen et al. 2026)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor

from surfkit.plugin import ADC, BadInput, Edit, Points, Step, Views, admitted

KEY_BITS = 21
"""Of the number of a voxel along one axis: three of them fit into 63 bits."""


@dataclass(frozen=True)
class SparsityCompensation(ADC):
    """Densify as ADC does, and split besides what is large where points are sparse (MetroGS, section 4.2.2, Sparsity
    Compensation Densification).

    Where a place has few points these become large and coarse, and where few views see them, their gradients are too
    small for ADC. At the edits of ADC, eq. 5 chooses points for splitting too: G_split = { G_i | S_i > S_th and
    V_i < V_th }. S_i is the accumulated area, the sum over the pixels x of the views of [i_max(x) = i and
    i_mid(x) = i], with i_max the point of the largest weight alpha T on the ray, and i_mid that of the median depth.
    V_i is the local density: how many points have their centres in the voxel that the centre of point i lies in.

    What both name is split. Filters apply to both, and where one limits the number of points, those that ADC names come
    first, then those of the largest area.
    """

    divides: ClassVar[bool] = False

    area: float = 20.0
    """Area S above which a point may be split: pixels, of all views together (S_th). Photographs of half the width show
    a point with a quarter of it, and nothing makes up for that."""

    crowd: int = 10
    """Number of points in a voxel from which on none of them is split, each counting itself (V_th)."""

    voxel: float = 0.01
    """Side of a voxel, as a share of the scene extent. The paper has 0.1 or 0.01 in the units of its data, of about
    100 m, by the size of the scene; this share is a choice of surfkit, that of `small`."""

    views: int = 100
    """Training views that S is summed over, drawn anew at each edit; all, if there are no more. The paper leaves open
    which ones; these cost as many forward passes as ADC leaves steps between edits."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.area:
            raise BadInput(f"densify.area is {self.area}; it must be 0 or more pixels")
        if not 0 < self.voxel < float("inf"):
            raise BadInput(f"densify.voxel is {self.voxel}; it must be above 0, a share of the scene extent")
        for name in ("crowd", "views"):
            if getattr(self, name) < 1:
                raise BadInput(f"densify.{name} is {getattr(self, name)}; it must be 1 or more")

    @property
    def needs_leading(self) -> bool:
        """See `Densify.needs_leading`."""
        return True

    def edit(self, points: Points, step: Step) -> Edit | None:
        """As ADC; where points are added, those of eq. 5 are split too."""
        if not self.is_due(step.index):
            return super().edit(points, step)
        want = self.want(points, step)
        sparse, area = self.sparse(step)
        named = want > 0
        least = want[named].min() if bool(named.any()) else want.new_ones(())
        behind = least * area.to(want) / (2 * area.max().clamp_min(1))  # all of them below the least of ADC
        hot = admitted(self.filters, step, torch.where(sparse & ~named, behind, want))
        edit = self.edit_of(points, step, hot)
        assert edit.clone is not None and edit.split is not None, "ADC gives both"
        return replace(edit, clone=edit.clone & ~sparse, split=edit.split | (edit.clone & sparse))

    def sparse(self, step: Step) -> tuple[Tensor, Tensor]:
        """(N,) bool, the points of eq. 5, and (N,) int64 the area S of each; 0 of all where no voxel is sparse."""
        means = step.splats.means
        alone = (density(means, self.voxel) < self.crowd) & step.may_be_densified()
        if not bool(alone.any()):
            return alone, torch.zeros_like(alone, dtype=torch.int64)
        area = step.views.leading(self._drawn(step.views, step.seed)).to(means.device)
        return alone & (area > self.area), area

    def _drawn(self, views: Views, seed: int) -> list[int] | None:
        """Places of the views to look at; None for all."""
        if len(views) <= self.views:
            return None
        order = torch.randperm(len(views), generator=torch.Generator().manual_seed(seed))
        return sorted(order[: self.views].tolist())


def density(means: Tensor, voxel: float) -> Tensor:
    """(N,) int64, how many of N points lie in the voxel that each lies in, itself included (V of eq. 5).

    Points beyond 2^20 voxels of the origin count as if they lay in the outermost one.

    Args:
        means: (N, 3).
        voxel: Side of a voxel, in the same unit; the grid has a corner in the origin.
    """
    most = 1 << (KEY_BITS - 1)
    x, y, z = (means.double() / voxel).floor().clamp(-most, most - 1).long().unbind(1)
    keys = (((x + most) << KEY_BITS) + (y + most) << KEY_BITS) + z + most
    _, voxel_of, counts = keys.unique(return_inverse=True, return_counts=True)
    return counts[voxel_of]
