"""Levels of detail by merging splats."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import torch

from surfkit.compress.levels.base import LevelsOfDetail, LodInput
from surfkit.compress.levels.cut import cut, depth_for
from surfkit.compress.levels.lod_tree import LodBlock, LodTree
from surfkit.compress.levels.merge_cost import groups, summed
from surfkit.compress.levels.moments import alike, merged_model, refuse_unmergeable
from surfkit.compress.levels.refine_levels import contributions, refined
from surfkit.core.check import BadInput
from surfkit.core.events import Progress, emit
from surfkit.core.schedule import StepCount
from surfkit.primitives.base import Primitive
from surfkit.primitives.model import SplatModel

AFAR = 2**0.5
"""A level with half the points is seen from so many times the distance: points of a surface are then as dense in the
image. The first level is drawn at about the distance of the photographs."""

Moments = tuple[np.ndarray, np.ndarray]
"""(N,) weight of each point of a level: the contribution of the points of the full model that it stands for; and (N,)
their mean squared distance from it."""


@dataclass(frozen=True)
class MergedLevels(LevelsOfDetail):
    """Merge splats that are near and alike, block by block: each level has half the points of the one below.

    Blocks are the halves of the halves of the scene. Two neighbours become one of the next level with as many points
    as each of them had. Merged splats keep the mean, the covariance and the opacity times area of those that they stand
    for, weighted by what these contribute to the training views, and then learn from renders of the full model.
    """

    tile_points: int = 8_192
    """Most points of a block; the scene is halved until no block has more, once for each level."""

    steps: Annotated[int, StepCount(floor=100)] = 300
    """Optimisation steps of each level, on renders of the full model by the training cameras; 0 for none. Short runs
    keep at least 100."""

    def __post_init__(self) -> None:
        if self.tile_points < 2:
            raise BadInput(f"lod.tile_points is {self.tile_points}; it must be 2 or more")
        if self.steps < 0:
            raise BadInput(f"lod.steps is {self.steps}; it must be 0 or more")

    def refuse_unfit(self, primitive: Primitive) -> None:
        """See `LevelsOfDetail.refuse_unfit`."""
        refuse_unmergeable(primitive, "merge")

    def build(self, given: LodInput) -> LodTree:
        """See `LevelsOfDetail.build`."""
        self.refuse_unfit(given.model.primitive)
        depth = depth_for(len(given.model), self.tile_points)
        order, bounds = cut(given.model.splats.means.detach().double().cpu().numpy(), depth)
        levels = [given.model.take(torch.from_numpy(order))]
        known = contributions(given).numpy()[order], np.zeros(len(order))
        ends = bounds[depth]
        errors, limits = [np.zeros(len(ends) - 1)], [ends]
        for number in range(1, depth + 1):
            level, known, ends = halved(levels[-1], known, ends[::2], number)
            levels.append(refined(given, level, number, self.steps, AFAR ** (number - 1)))
            errors.append(block_errors(known, ends))
            limits.append(ends)
        return LodTree.of(order, levels, blocks(limits, errors))


def halved(level: SplatModel, known: Moments, ends: np.ndarray, number: int) -> tuple[SplatModel, Moments, np.ndarray]:
    """The next level with half the points in each block, what is known of them, and the bounds of the blocks in it.

    One block after the other, so that what this takes beside the levels does not grow with the scene.

    Args:
        level: To merge points of.
        known: Of its points.
        ends: (B + 1,) bounds of the blocks of the next level in this one.
        number: Of the next level.
    """
    parts, moments = [], []
    for at, (first, last) in enumerate(zip(ends[:-1].tolist(), ends[1:].tolist(), strict=True)):
        part, (weights, spread) = level.take(slice(first, last)), (each[first:last] for each in known)
        labels = groups(alike(part.splats, weights), (last - first + 1) // 2)
        parts.append(merged_model(part, labels, weights))
        moments.append(carried(part, parts[-1], labels, (weights, spread)))
        emit(Progress(f"merging to level {number} of detail", at + 1, len(ends) - 1))
    shared, one = level.primitive.shared(), parts[0].params
    params = {n: v if n in shared else torch.cat([part.params[n] for part in parts]) for n, v in one.items()}
    weights, spread = (np.concatenate(each) for each in zip(*moments, strict=True))
    return replace(level, params=params), (weights, spread), np.cumsum([0, *map(len, parts)])


def carried(before: SplatModel, after: SplatModel, labels: np.ndarray, known: Moments) -> Moments:
    """What is known of the points of the next level; `labels`: (N,), into which of them each point goes."""
    weights, spread = known
    places, means = (each.splats.means.detach().double().cpu().numpy() for each in (before, after))
    far = ((places - means[labels]) ** 2).sum(1)
    total = summed(weights, labels)
    return total, summed(weights * (spread + far), labels) / total


def block_errors(known: Moments, ends: np.ndarray) -> np.ndarray:
    """(B,) root mean square distance of the points of the full model from those that stand for them, weighted."""
    weights, spread = known
    return np.sqrt(np.add.reduceat(weights * spread, ends[:-1]) / np.add.reduceat(weights, ends[:-1]))


def blocks(limits: list[np.ndarray], errors: list[np.ndarray]) -> list[LodBlock]:
    """The blocks of all levels, the root first.

    Args:
        limits: Of each level, the finest first: (B + 1,) rows at which its blocks begin and end.
        errors: Of each level: (B,) of its blocks.
    """
    found: list[LodBlock] = []
    above = -1
    for level in range(len(limits) - 1, -1, -1):
        begin, ends = len(found), limits[level]
        for at in range(len(ends) - 1):
            parent = above + at // 2 if above >= 0 else -1
            found.append(LodBlock(level, int(ends[at]), int(ends[at + 1]), parent, float(errors[level][at])))
        above = begin
    return found
