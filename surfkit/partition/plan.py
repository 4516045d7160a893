"""The plan of the blocks: their cells, views and sizes, and nothing that is silently left out."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from surfkit.core.check import BadInput, expect_kind, expect_tensor
from surfkit.core.events import Warned, emit
from surfkit.core.registry import class_path
from surfkit.partition.assign import Assign, inside
from surfkit.partition.base import Cells, CoarseModel, Partition

COUNTING_VIEWS = 16
"""Views by which the points around a block are counted."""


@dataclass(frozen=True)
class BlockPlan:
    """One block.

    Attributes:
        index: ViewCounts from 0.
        views: Names of the views it is tuned on; empty if it stays as it is in the coarse model.
        cameras: How many of them stand inside.
        points: Of the coarse model that it owns.
        work: Pixels of the views times the points, as a share of all blocks'.
        begins: Points that it begins with, about: those, and what its views show of others'; 0 where nobody looked.
    """

    index: int
    views: tuple[str, ...]
    cameras: int
    points: int
    work: float
    begins: int = 0


@dataclass(frozen=True)
class PartitionPlan:
    """How a scene is cut, and who trains on what.

    Attributes:
        cells: Which block owns what.
        blocks: In the order of their index.
    """

    cells: Cells
    blocks: tuple[BlockPlan, ...]

    def __post_init__(self) -> None:
        if [block.index for block in self.blocks] != list(range(self.cells.count)):
            raise BadInput(f"plan: {len(self.blocks)} blocks for {self.cells.count} in the cells, or out of order")


@dataclass(frozen=True)
class BlockMinimums:
    """How many views and points a block needs.

    Attributes:
        views: In a large scene.
        share: In a small one: of the views that each block would get if they were divided among the blocks.
        points: Share of the points that each block would get.
    """

    views: int = 50
    share: float = 0.25
    points: float = 0.05

    def of(self, views: int, blocks: int) -> int:
        """The number for a scene."""
        return max(1, min(self.views, round(self.share * views / blocks)))


def plan(
    sight: CoarseModel,
    partition: Partition,
    assign: Assign,
    fewest: BlockMinimums | None = None,
    begun: CoarseModel | None = None,
) -> PartitionPlan:
    """Cut, find the views of every block, and join blocks with too few of them to their neighbours.

    Args:
        sight: The model that decides.
        partition: How to cut.
        assign: How to choose views.
        fewest: What a block needs.
        begun: The model that the blocks begin with, whose points are counted; the one that decides if None.

    Raises:
        BadInput: The scene cannot be cut, or no block has a view.
    """
    cells = partition.cells(sight)
    expect_kind(f"{class_path(type(partition))}.cells", cells, Cells)
    cells.refuse_untiled(f"{class_path(type(partition))}.cells")
    owner = cells.owner(sight.splats.means)
    joins = assign.joins(sight, cells)
    expect_tensor(f"{class_path(type(assign))}.joins", joins, ("bool",), (len(sight.views), cells.count))
    if not joins.any():
        raise BadInput("partition: no view shows any block; lower the threshold of the assignment")
    here = inside(sight, cells) & joins
    fewest = fewest or BlockMinimums()
    poor = torch.bincount(owner, minlength=cells.count) < fewest.points * len(owner) / cells.count
    cells, joins, here = with_enough(cells, joins, here, fewest.of(len(sight.views), cells.count), poor)
    if assign.most_views is not None:
        joins = thinned(joins, assign.most_views, sight.seed)
    return PartitionPlan(cells, blocks_of(begun or sight, cells, joins, here & joins))


def thinned(joins: Tensor, most: int, seed: int) -> Tensor:
    """(V, B) views that join each block, without those, drawn by chance, that are more than `most`."""
    # not the draws that views may have joined by, which would favour some
    ranks = torch.rand(joins.shape, generator=torch.Generator().manual_seed((seed + 1) % 2**63)).where(joins, 2.0)
    order = ranks.argsort(dim=0, stable=True).argsort(dim=0, stable=True)
    return joins & (order < most)


def blocks_of(sight: CoarseModel, cells: Cells, joins: Tensor, inside: Tensor) -> tuple[BlockPlan, ...]:
    """What there is to say of every block, from (V, B) views that join and that stand inside."""
    owner = cells.owner(sight.splats.means)
    points = torch.bincount(owner, minlength=cells.count)
    work = (joins * sight.pixels[:, None]).sum(0) * points
    share = (work / work.sum().clamp_min(1)).tolist()
    names = [view.name for view in sight.views]
    return tuple(
        BlockPlan(
            index,
            tuple(name for name, here in zip(names, joins[:, index].tolist(), strict=True) if here),
            int(inside[:, index].sum()),
            int(points[index]),
            share[index],
            begins(sight, owner == index, joins[:, index]),
        )
        for index in range(cells.count)
    )


def begins(sight: CoarseModel, own: Tensor, joins: Tensor) -> int:
    """Points that a block begins with, by (N,) those that it owns and what some of its (V,) views show."""
    views, seen = joins.nonzero()[:, 0].tolist(), own.clone()
    for at in views[:: -(-len(views) // COUNTING_VIEWS) or 1]:
        seen |= sight.rasterizer.render(sight.splats, sight.views[at].camera, sight.near, geometry=False).seen
    return int(seen.sum())


def with_enough(cells: Cells, joins: Tensor, inside: Tensor, fewest: int, poor: Tensor) -> tuple[Cells, Tensor, Tensor]:
    """Join each block with too few views or points to the touching one that shares the most of its views.

    Args:
        cells: As cut.
        joins: (V, B) bool, the views of each block.
        inside: (V, B) bool, the cameras in each.
        fewest: Views that a block needs.
        poor: (B,) bool, blocks with too few points.

    Returns:
        Cells, joins and inside of the blocks that are left.
    """
    groups = {block: {block} for block in range(cells.count)}
    views, beside = dict(enumerate(joins.T.contiguous())), touching(cells)
    while len(groups) > 1:
        least = min(groups, key=lambda at: (not poor[list(groups[at])].all(), int(views[at].sum()), at))
        count, few_points = int(views[least].sum()), bool(poor[list(groups[least])].all())
        if count >= fewest and not few_points:
            break
        partner = max(beside[least], key=lambda at: (int((views[at] & views[least]).sum()), int(views[at].sum()), -at))
        lack = "hardly any points" if few_points else f"{count} views, fewer than {fewest},"
        emit(Warned(f"partition: a block with {lack} is joined to its neighbour"))
        groups[partner] |= groups.pop(least)
        views[partner] = views[partner] | views.pop(least)
        for at in beside.pop(least):
            beside[at].discard(least)
            if at != partner:
                beside[at].add(partner)
                beside[partner].add(at)
    joined = sorted(groups.values(), key=min)
    number = {block: at for at, group in enumerate(joined) for block in group}
    cells = replace(cells, blocks=tuple(number[block] for block in cells.blocks))
    joins, inside = (torch.stack([table[:, sorted(g)].any(1) for g in joined], 1) for table in (joins, inside))
    return cells, joins, inside


def touching(cells: Cells) -> dict[int, set[int]]:
    """Of each block, the others whose cells have more than a corner in common with its own."""
    infinity = float("inf")
    sides = torch.tensor(
        [[(-infinity if at < 2 else infinity) if s is None else s for at, s in enumerate(box)] for box in cells.boxes],
        dtype=torch.float64,
    )
    found: dict[int, set[int]] = {block: set() for block in range(cells.count)}
    for side, block in zip(sides, cells.blocks, strict=True):
        x, y = (torch.minimum(side[2:], sides[:, 2:]) - torch.maximum(side[:2], sides[:, :2])).unbind(1)
        for at in (((x == 0) & (y > 0)) | ((y == 0) & (x > 0))).nonzero()[:, 0].tolist():
            if cells.blocks[at] != block:
                found[block].add(cells.blocks[at])
    return found
