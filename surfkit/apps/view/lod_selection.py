"""Which splats of a large model a camera needs: fine near it, coarse far away, few beside what it sees."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from surfkit.compress.levels.lod_tree import LodTree
from surfkit.io.splats.splat_table import SPLAT_COLUMNS, SplatTable
from surfkit.raster.api import CUTOFF
from surfkit.scene.camera import Camera

OUTSIDE_WEIGHT = 1 / 16
"""What lengths count beside the image in a lot, as a share: a camera that turns meets something there."""
OUTSIDE_BUDGET_SHARE = 0.1
"""Of the budget, for the coarsest levels of detail beside the image."""
VIEW_WIDENING = 1.1
"""By which the image is widened: what lies at its border is there when the camera turns a little."""
SAMPLES_PER_BLOCK = 32
"""Splats of a block that tell how many of them the camera sees."""
SAFE_BUDGET_SHARE = 0.98
"""Of the budget, where the samples have told too few."""
PASS_SPLATS = 1 << 20
"""Splats that are looked at together, so that it takes little memory."""


@dataclass(frozen=True)
class LodCamera:
    """A camera that chooses.

    Attributes:
        camera: Local frame.
        near: Nearest depth that it sees, local units.
    """

    camera: Camera
    near: float

    def widened(self) -> LodCamera:
        """With a wider image, see `VIEW_WIDENING`."""
        camera = self.camera
        return replace(self, camera=replace(camera, fx=camera.fx / VIEW_WIDENING, fy=camera.fy / VIEW_WIDENING))

    def sees(self, means: Tensor, reach: Tensor) -> tuple[Tensor, Tensor]:
        """(N,) bool, whether a ball touches the image, and (N,) its distance, at least its radius.

        Args:
            means: (N, 3) float32 middles, local frame.
            reach: (N,) radii.
        """
        camera = self.camera
        pose = camera.world_to_camera.float()
        x, y, z = (means @ pose[:3, :3].T + pose[:3, 3]).unbind(1)
        found = z + reach > self.near
        sides = (x, camera.fx, camera.cx, camera.width), (y, camera.fy, camera.cy, camera.height)
        for along, focal, centre, size in sides:
            for sign, slope in ((1.0, centre / focal), (-1.0, (size - centre) / focal)):
                found &= sign * along + slope * z + math.hypot(1.0, slope) * reach >= 0
        return found, torch.maximum((x * x + y * y + z * z).sqrt(), reach)


@dataclass(frozen=True)
class ChosenSplats:
    """Splats that stand for a model.

    Attributes:
        ids: (n,) int64, each once; the same splat has the same number for every camera.
        table: The splats, local frame.
    """

    ids: np.ndarray
    table: SplatTable

    def __len__(self) -> int:
        return len(self.ids)


class SampledPoints:
    """Points of a cloud, drawn by lot: the nearer to the camera, the more likely.

    Priority sampling (Duffield, Lund and Thorup, "Priority sampling for estimation of arbitrary subset sums", 2007):
    each point has a weight, which is divided by the square of its distance; its priority is that divided by a random
    number between 0 and 1, and those with the highest priorities are kept. The random numbers are the same for all
    cameras, so that a camera that moves a little keeps most of its points.
    """

    def __init__(self, means: Tensor, weights: Tensor | None = None, reach: Tensor | None = None) -> None:
        """Of (N, 3) positions, (N,) logarithms of weights, else the same for all, and (N,) radii, else 0."""
        count = len(means)
        self.means = means.float()
        self.weights = torch.zeros(count) if weights is None else weights
        self.reach = torch.zeros(count) if reach is None else reach
        self.luck = -torch.rand(count, generator=torch.Generator().manual_seed(0)).clamp_min(1e-12).log()

    def rows(self, budget: int, eye: LodCamera | None = None) -> tuple[Tensor, Tensor]:
        """(n,) int64 rows in their order, of fewer than there are, for a camera or for no one in particular.

        Also (n,) by how much the logarithms of their weights are raised, so that they stand for those that are not
        kept: to the highest priority among these, so that the expected sum of each part of the image stays as it is.
        """
        weights, beside = (self.weights, None) if eye is None else self._seen_by(eye.widened())
        priorities = weights + self.luck
        best = priorities.topk(budget + 1).indices
        least = priorities[best[budget]]
        rows = best[:budget].sort().values
        raised = (least - weights[rows]).clamp_min(0)
        if beside is not None:
            raised[beside[rows]] = 0  # so large, they would reach into the image
        return rows, raised

    def _seen_by(self, eye: LodCamera) -> tuple[Tensor, Tensor]:
        """(N,) logarithms of weights, and (N,) bool, whether a point lies beside the image."""
        weights, beside = torch.empty(len(self.weights)), torch.empty(len(self.weights), dtype=torch.bool)
        for first in range(0, len(weights), PASS_SPLATS):
            part = slice(first, first + PASS_SPLATS)
            inside, distance = eye.sees(self.means[part], self.reach[part])
            weights[part] = (
                self.weights[part] - 2 * distance.log() + torch.where(inside, 0.0, 2 * math.log(OUTSIDE_WEIGHT))
            )
            beside[part] = ~inside
        return weights, beside


class SampledSplats(SampledPoints):
    """Splats of a model without levels of detail: drawn by lot, and enlarged so that they stand for the others.

    The weight of a splat is its opacity times the area of its image; weights are raised by the area.
    """

    def __init__(self, table: SplatTable) -> None:
        """Of a table in the local frame."""
        super().__init__(table.means, visibility(table), reach_of(table))
        self.table = of_degree_0(table)

    def choose(self, budget: int, eye: LodCamera | None = None) -> ChosenSplats:
        """At most `budget` splats for a camera, or for no camera in particular."""
        if len(self.weights) <= budget:
            return ChosenSplats(np.arange(len(self.weights)), self.table)
        rows, raised = self.rows(budget, eye)
        found = self.table.take(rows)
        return ChosenSplats(rows.numpy(), replace(found, log_scales=found.log_scales + raised[:, None] / 2))


class LodSplats:
    """Splats of levels of detail."""

    def __init__(self, tree: LodTree) -> None:
        """Of a tree whose primitive files of splats have a place for."""
        self.blocks = blocks = tree.blocks
        self.tables = [of_degree_0(level.primitive.table(level.params)).on_cpu() for level in tree.levels]
        self.starts = np.concatenate([[0], np.cumsum([len(table) for table in self.tables])])
        self.sizes = blocks.last - blocks.first
        steps = (np.arange(SAMPLES_PER_BLOCK) + 0.5) / SAMPLES_PER_BLOCK
        rows = self.starts[blocks.level, None] + blocks.first[:, None] + (steps * self.sizes[:, None]).astype(np.int64)
        self.samples = self._take(np.minimum(rows, self.starts[-1] - 1).reshape(-1))

    def choose(self, budget: int, eye: LodCamera) -> ChosenSplats | None:
        """At most `budget` splats for a camera; None if the coarsest ones that it sees are more."""
        eye = eye.widened()
        outside = self.blocks.outside(eye.camera, eye.near)
        errors = np.where(outside, 0.0, self.blocks.pixels(eye.camera))
        inside, _ = eye.sees(self.samples.means.float(), reach_of(self.samples))
        share = inside.view(-1, SAMPLES_PER_BLOCK).float().mean(1).clamp_min(0.5 / SAMPLES_PER_BLOCK).numpy()
        points = np.where(outside, 0.0, self.sizes * share)
        most = allowed = budget - min(OUTSIDE_BUDGET_SHARE * budget, self.sizes[outside & self.blocks.is_leaf].sum())
        while allowed >= 1 and (front := self.blocks.front_within(errors, points, int(allowed))) is not None:
            ids = self._ids(front[~outside[front]])
            found = self._take(ids)
            kept = eye.sees(found.means.float(), reach_of(found))[0].numpy()
            if (count := int(kept.sum())) <= most:
                return self._with_beside(ids[kept], front[outside[front]], budget - count)
            allowed *= SAFE_BUDGET_SHARE * most / count
        return None

    def _with_beside(self, ids: np.ndarray, beside: np.ndarray, room: int) -> ChosenSplats:
        """Splats that are seen, and for so many more, blocks that are not: the coarsest first."""
        beside = beside[np.argsort(-self.blocks.level[beside], kind="stable")]
        ids = np.concatenate([ids, self._ids(beside[np.cumsum(self.sizes[beside]) <= room])])
        return ChosenSplats(ids, self._take(ids))

    def _ids(self, front: np.ndarray) -> np.ndarray:
        """(n,) rows of some blocks, counted through all levels."""
        sizes, starts = self.sizes[front], self.starts[self.blocks.level[front]] + self.blocks.first[front]
        before = np.cumsum(sizes) - sizes
        return np.repeat(starts - before, sizes) + np.arange(sizes.sum())

    def _take(self, ids: np.ndarray) -> SplatTable:
        """Splats by `_ids`, in their order."""
        if not len(ids):
            return self.tables[0].take(slice(0, 0))
        level = np.searchsorted(self.starts, ids, side="right") - 1
        order = np.argsort(level, kind="stable")
        parts = [
            self.tables[number].take(torch.from_numpy(ids[level == number] - self.starts[number]))
            for number in np.unique(level)
        ]
        back = torch.from_numpy(np.argsort(order, kind="stable"))
        return replace(
            parts[0], **{name: torch.cat([getattr(part, name) for part in parts])[back] for name in SPLAT_COLUMNS}
        )


def of_degree_0(table: SplatTable) -> SplatTable:
    """Without what browsers do not draw."""
    return replace(table, sh_rest=table.sh_rest[:, :0])


def visibility(table: SplatTable) -> Tensor:
    """(N,) float32 logarithms of opacity times area, seen from distance 1 where that is largest."""
    largest = table.log_scales.float().topk(2, dim=1).values.sum(1)
    return largest + torch.nn.functional.logsigmoid(table.opacity_logits.float())


def reach_of(table: SplatTable) -> Tensor:
    """(N,) how far splats extend."""
    return CUTOFF * table.log_scales.float().amax(1).exp()


def in_places(before: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """(n,) where each of the wanted splats goes: one that is there stays, the others take free places.

    A browser sorts its splats in a thread of its own: until that is done it draws new splats in the order of the old
    ones, and those that have stayed in their places are not seen to change.

    Args:
        before: (S,) int64 the splat in each place; -1 for none.
        wanted: (n,) splats, each once; n is at most S.
    """
    order = np.argsort(before, kind="stable")
    at = np.minimum(np.searchsorted(before, wanted, sorter=order), len(before) - 1)
    places = np.where(before[order[at]] == wanted, order[at], -1)
    free = np.ones(len(before), bool)
    free[places[places >= 0]] = False
    new = places < 0
    places[new] = free.nonzero()[0][: new.sum()]
    return places
