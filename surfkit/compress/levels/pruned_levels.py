"""Levels of detail by dropping splats, as CityGaussian does it (Liu et al. 2024, section 3.4)."""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from torch import Tensor

from surfkit.compress.levels.base import LevelsOfDetail, LodInput
from surfkit.compress.levels.cut import cut, depth_for
from surfkit.compress.levels.lod_tree import LodBlock, LodTree
from surfkit.compress.levels.refine_levels import refined
from surfkit.core.check import BadInput
from surfkit.core.schedule import StepCount
from surfkit.densify.prune import importance
from surfkit.densify.trim import lowest
from surfkit.primitives.drawing import drawn_by
from surfkit.primitives.model import SplatModel
from surfkit.train.view_order import ViewContributions


@dataclass(frozen=True)
class PrunedLevels(LevelsOfDetail):
    """Drop the points of least importance for each level, as CityGaussian does: more from farther away.

    Blocks are the halves of the halves of the scene; each has all levels. Importance is that of LightGaussian. What is
    left learns from renders of the full model.
    """

    keep: tuple[float, ...] = (0.68, 0.5)
    """Share of the points of the full model that each further level has. With a model that has half of its points left,
    the defaults are the 50, 34 and 25 % of CityGaussian on MatrixCity."""

    distances: tuple[float, ...] = ()
    """Distance in metres from which each of these levels is drawn, at the focal length of the photographs, such as 200
    400. Without any, a block is drawn in the finest level whose mean scale is more than two pixels, as in the released
    code, else in the coarsest."""

    tile_points: int = 8_192
    """Most points of a block of the full model."""

    power: float = 0.1
    """Of the volume in the importance."""

    steps: Annotated[int, StepCount(floor=100)] = 300
    """Optimisation steps of each level, on renders of the full model by the training cameras; 0 for none. Short runs
    keep at least 100."""

    def __post_init__(self) -> None:
        falls = all(before > after for before, after in itertools.pairwise((1.0, *self.keep, 0.0)))
        if not self.keep or not falls:
            raise BadInput(f"lod.keep is {self.keep}; give shares between 1 and 0 that fall, such as 0.68 0.5")
        rises = all(before < after for before, after in itertools.pairwise((0.0, *self.distances)))
        if self.distances and (len(self.distances) != len(self.keep) or not rises):
            raise BadInput(
                f"lod.distances is {self.distances}; give one for each of the {len(self.keep)} shares of lod.keep, "
                "above 0 and rising, or none"
            )
        if self.tile_points < 1:
            raise BadInput(f"lod.tile_points is {self.tile_points}; it must be 1 or more")
        if self.steps < 0:
            raise BadInput(f"lod.steps is {self.steps}; it must be 0 or more")

    def build(self, given: LodInput) -> LodTree:
        """See `LevelsOfDetail.build`."""
        focal = statistics.median(max(view.camera.fx, view.camera.fy) for view in given.views)
        limits = [0.0, *(self._local(given, distance) / focal for distance in self.distances)]
        depth = depth_for(len(given.model), self.tile_points)
        order, bounds = cut(given.model.splats.means.detach().double().cpu().numpy(), depth)
        full = given.model.take(torch.from_numpy(order))
        tally = ViewContributions(given.views, drawn_by(full.primitive, given.rasterizer), full.splats, full.near)
        scores = importance(tally, full.splats.detached(), self.power).cpu()
        levels, ends = [full], [bounds[depth]]
        for number, share in enumerate(self.keep, 1):
            kept = kept_rows(scores, share, bounds[depth])
            levels.append(refined(given, full.take(kept), number, self.steps, smaller=1.0))
            ends.append(np.searchsorted(kept.numpy(), bounds[depth]))
        errors = (
            [np.full(len(bounds[depth]) - 1, limit) for limit in limits] if self.distances else sights(levels, ends)
        )
        return LodTree.of(order, levels, list(chains(ends, errors)))

    def _local(self, given: LodInput, distance: float) -> float:
        """A distance in local units."""
        if given.frame.local_metres is None:
            raise BadInput(
                "lod.distances are in metres, and the data set does not say how long a unit is; give the length with "
                "--metres-per-unit (1 if its coordinates are metres), or leave out the distances"
            )
        return distance / given.frame.local_metres


def kept_rows(scores: Tensor, share: float, bounds: np.ndarray) -> Tensor:
    """Rows of the points whose scores are highest, and of the best of each block, in order.

    Args:
        scores: (N,) importance.
        share: How many of them to keep.
        bounds: (B + 1,) of the blocks.
    """
    kept = ~lowest(scores, 1 - share)
    for first, last in itertools.pairwise(bounds.tolist()):
        kept[first + int(scores[first:last].argmax())] = True
    return kept.nonzero()[:, 0]


def sights(levels: Sequence[SplatModel], ends: Sequence[np.ndarray]) -> list[np.ndarray]:
    """(B,) error of each block in each level, so that a block is drawn within an error of a pixel in the finest level
    whose scale is more than two pixels: half of the largest scale of the finer levels.

    Args:
        levels: The finest first.
        ends: (B + 1,) bounds of the blocks in each.
    """
    found = [np.zeros(len(ends[0]) - 1)]
    for level, limits in zip(levels[:-1], ends[:-1], strict=True):
        scales = level.splats.scales.detach().double().cpu().numpy()
        mean = np.add.reduceat(scales, limits[:-1], axis=0) / np.diff(limits)[:, None]
        found.append(np.maximum(found[-1], mean.max(1) / 2))
    return found


def chains(ends: Sequence[np.ndarray], errors: Sequence[np.ndarray]) -> Iterator[LodBlock]:
    """The blocks: the whole coarsest level, below it each of its parts, and below these the same in finer levels.

    Args:
        ends: Of each level, the finest first: (B + 1,) rows at which its parts begin and end.
        errors: Of each level: (B,) of its parts.
    """
    coarsest, count = len(ends) - 1, len(ends[0]) - 1
    before = 0
    if count > 1:
        yield LodBlock(coarsest, 0, int(ends[-1][-1]), -1, float(errors[-1].max()))
        before = 1
    for level in range(coarsest, -1, -1):
        for at in range(count):
            above = before - 1 if level == coarsest else before + (coarsest - level - 1) * count + at
            parent = above if count > 1 or level < coarsest else -1
            yield LodBlock(level, int(ends[level][at]), int(ends[level][at + 1]), parent, float(errors[level][at]))
