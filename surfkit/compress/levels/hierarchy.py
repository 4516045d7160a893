"""A hierarchy of splats (Kerbl et al. 2024, A Hierarchical 3D Gaussian Representation for Real-Time Rendering of Very
Large Datasets)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from torch import Tensor

from surfkit.compress.levels.base import LevelsOfDetail, LodInput
from surfkit.compress.levels.cut import cut, depth_for
from surfkit.compress.levels.lod_tree import LodBlock
from surfkit.compress.levels.merged_levels import blocks
from surfkit.compress.levels.moments import Shapes, merged_model, refuse_unmergeable
from surfkit.compress.levels.refine_levels import renders
from surfkit.compress.levels.splat_tree import Cut, NodeBoxes, SplatTree, boxes_of
from surfkit.core.check import BadInput
from surfkit.core.events import Progress, Warned, emit
from surfkit.core.schedule import StepCount, log_linear
from surfkit.densify.signal import LossGradient
from surfkit.losses.base import Target
from surfkit.losses.photometric import L1, SSIM
from surfkit.primitives.base import Primitive
from surfkit.primitives.model import SplatModel
from surfkit.primitives.points import Columns, Points
from surfkit.raster.api import Splats
from surfkit.scene.cache import Cache
from surfkit.scene.scene import View
from surfkit.train import checkpoint
from surfkit.train.adam import adam_step
from surfkit.train.faults import Diverged, require_finite_losses, require_finite_values
from surfkit.train.loss_gradients import loss_gradients, pulled
from surfkit.train.state import StageState
from surfkit.train.view_order import ViewOrder

RATES = {"sh0": 5e-4, "sh_rest": 5e-4 / 20, "opacities": 1e-2, "scales": 1e-3}
"""Learning rates of inner nodes, as published; positions, rotations and all else stay. Of the higher harmonics as in
3DGS, a twentieth of that of the first."""
LOSSES = {"l1": L1(), "ssim": SSIM()}
KEPT_EVERY = 500
"""Steps between states that are kept."""
LEAST_WEIGHT = 1e-30
"""Of a splat in a merge, where opacity times area is 0 in float32."""


@dataclass(frozen=True)
class Hierarchy(LevelsOfDetail):
    """A binary tree in which every two splats have a merged one above them, drawn by size on the screen, as in
    Hierarchical 3DGS (Kerbl et al. 2024).

    Splats are halved at the median of their longest axis down to single ones. A merged splat keeps the mean, the
    covariance and the opacity times area of its two children, weighted by these. Inner nodes then learn from renders of
    the full model at a random granularity for each view, and the leaves stay as they are.
    """

    tile_points: int = 8_192
    """Most points of a block, for programs that load blocks, such as `surfkit view`."""

    steps: Annotated[int, StepCount(floor=100)] = 15_000
    """Optimisation steps of the inner nodes, all levels together; 0 for none. Short runs keep at least 100."""

    finest: float = 0.005
    """Smallest granularity that is learnt: size of a node over its distance, drawn evenly in the logarithm."""

    coarsest: float = 0.1
    """Largest granularity that is learnt."""

    def __post_init__(self) -> None:
        if self.tile_points < 2:
            raise BadInput(f"lod.tile_points is {self.tile_points}; it must be 2 or more")
        if self.steps < 0:
            raise BadInput(f"lod.steps is {self.steps}; it must be 0 or more")
        if not 0 < self.finest <= self.coarsest < math.inf:
            raise BadInput(
                f"lod.finest is {self.finest:g} and lod.coarsest {self.coarsest:g}; the first must be above 0, and the "
                "second as large or larger"
            )

    def refuse_unfit(self, primitive: Primitive) -> None:
        """See `LevelsOfDetail.refuse_unfit`."""
        refuse_unmergeable(primitive, "hierarchy")

    def build(self, given: LodInput) -> SplatTree:
        """See `LevelsOfDetail.build`."""
        self.refuse_unfit(given.model.primitive)
        tree = merged_tree(given.model, self.tile_points)
        return self.optimised(given, tree) if self.steps else tree

    def optimised(self, given: LodInput, tree: SplatTree) -> SplatTree:
        """The tree after the optimisation of its inner nodes (section 5); as it was, with a warning, if it diverges.

        Every `KEPT_EVERY` steps the state is kept in `given.folder`; an interrupted call goes on from there.
        """
        pictures = renders(given, given.views)
        inner, path = InnerNodes.of(tree), given.folder / "hierarchy.safetensors"
        try:
            for state in inner.steps(given, pictures, self, kept_state(path, inner.points)):
                if state.index % KEPT_EVERY == 0 and state.index < self.steps:
                    checkpoint.save(path, state)
                emit(Progress("optimising the hierarchy", state.index, self.steps))
        except Diverged as error:
            emit(Warned(f"the hierarchy is not optimised: {error}"))
            return tree
        finally:
            pictures.close()
        known = tree.blocks  # whose splats may reach farther now
        rows = (each.tolist() for each in (known.level, known.first, known.last, known.parent, known.error))
        return SplatTree.of(tree.order, inner.levels(), [LodBlock(*row) for row in zip(*rows, strict=True)])


def kept_state(path: Path, like: Points) -> StageState | None:
    """The state that an interrupted call has kept in a file; None for none, and for one of other points than these."""
    try:
        found = checkpoint.load_last(path)
    except BadInput as error:
        emit(Warned(f"the optimisation of the hierarchy begins anew: {error}"))
        return None
    if found is None:
        return None
    ours, theirs = ({n: v.shape for n, v in each.params.items()} for each in (like, found[0].points))
    return found[0] if ours == theirs else None


def merged_tree(model: SplatModel, tile_points: int) -> SplatTree:
    """The tree of a model, merged from the leaves up (section 4.1).

    The weight of a splat is w = opacity x S, with S the surface of its ellipsoid. Mean and covariance are those of the
    mixture, and the opacity is sum(w) / S of the merged splat. In the paper that may be above 1, which is clamped pixel
    by pixel; here opacities end at 1, as in all files of splats: `Shapes.merged` says what is done with the excess.

    Args:
        model: Of a primitive that `refuse_unmergeable` takes.
        tile_points: Most points of a block.
    """
    depth = depth_for(len(model), 2)
    order, bounds = cut(model.splats.means.detach().double().cpu().numpy(), depth)
    levels = [model.take(torch.from_numpy(order))]
    labels = np.repeat(np.arange(2**depth), np.diff(bounds[-1]))
    for number in range(1, depth + 2):
        shapes = Shapes.of(levels[-1].splats)
        levels.append(merged_model(levels[-1], labels, np.maximum(shapes.opacities * shapes.areas, LEAST_WEIGHT)))
        labels = np.arange(len(levels[-1])) // 2
        emit(Progress("merging splats in pairs", number, depth + 1))
    boxes = boxes_of([level.splats for level in levels])
    return SplatTree.of(order, levels, tiles(boxes, bounds[depth_for(len(model), tile_points)]))


def tiles(boxes: Sequence[NodeBoxes], ends: np.ndarray) -> list[LodBlock]:
    """Blocks of the levels, the root first: two blocks make one of the next level, until there is only one.

    Args:
        boxes: Of the nodes of each level; the error of a block is its largest node, and that of leaves is 0.
        ends: (B + 1,) bounds of the blocks of leaves, of which there are 2^d.
    """
    limits, errors = [ends], [np.zeros(len(ends) - 1)]
    for box in boxes[1:]:
        count = max(1, (len(limits[-1]) - 1) // 2)
        limits.append(np.arange(count + 1) * len(box.reach) // count)
        errors.append(np.maximum.reduceat(box.size.astype(np.float64), limits[-1][:-1]))
    return blocks(limits, errors)


@dataclass
class InnerNodes:
    """The inner nodes of a tree while they are optimised.

    Attributes:
        tree: With the leaves, and the boxes by which it is cut, which do not change.
        points: Raw parameters of all inner nodes, from level 1 to the root.
    """

    tree: SplatTree
    points: Points

    @classmethod
    def of(cls, tree: SplatTree) -> InnerNodes:
        """Those of a tree, as they are."""
        first, *others = tree.levels
        shared = first.primitive.shared()
        params = {n: v if n in shared else torch.cat([o.params[n] for o in others]) for n, v in first.params.items()}
        return cls(tree, Points.fresh({n: v.detach().clone() for n, v in params.items()}, shared))

    def levels(self) -> tuple[SplatModel, ...]:
        """The levels with the parameters that the nodes have now."""
        starts = self.tree.starts - self.tree.starts[1]
        return self.tree.levels[0], *(
            replace(level, params={**level.params, **{n: v[a:b].clone() for n, v in self.points.params.items()}})
            for level, a, b in zip(self.tree.levels[1:], starts[1:-1].tolist(), starts[2:].tolist(), strict=True)
        )

    def steps(
        self, given: LodInput, pictures: Cache[Tensor], lod: Hierarchy, state: StageState | None
    ) -> Iterator[StageState]:
        """Take the steps that are left of `lod.steps`, and give the state after each.

        Args:
            given: With the views, the rasterizer and the seed.
            pictures: (3, H, W) uint8 of the full model, of each view.
            lod: With the granularities, drawn evenly in the logarithm.
            state: To go on from; None begins.
        """
        if state is None:
            state = StageState(self.points, ViewOrder(len(given.views)), torch.Generator().manual_seed(given.seed))
        state.move(next(iter(self.points.params.values())).device)
        self.points = state.points
        while state.index < lod.steps:
            at = state.order.next(state.generator)
            share = float(torch.rand((), generator=state.generator, dtype=torch.float64))
            state.index += 1
            granularity = log_linear(lod.finest, lod.coarsest, share)
            self.step(given, given.views[at], pictures[at], granularity, state.index)
            yield state

    def step(self, given: LodInput, view: View, picture: Tensor, granularity: float, index: int) -> float:
        """Draw one view at a granularity, compare it with what the full model draws, and move the inner nodes.

        Args:
            given: With the rasterizer.
            view: Of the camera.
            picture: (3, H, W) uint8 of the full model.
            granularity: Size over distance.
            index: Of the step, from 1.

        Returns:
            The loss before.

        Raises:
            Diverged: A value is not finite.
        """
        camera, model = view.camera, self.tree.levels[0]
        cut = self.tree.cut(camera, granularity * max(camera.fx, camera.fy), model.near)
        rows = torch.unique(torch.cat([cut.nodes, cut.parents]))
        inner = rows[rows >= len(model)] - len(model)
        leaves = {n: self.points.params[n][inner].requires_grad_() for n in RATES if n in self.points.params}
        shape = self.shown(cut, rows, inner, leaves)
        render = given.rasterizer.render(shape.detached(), camera, model.near, False, False)
        target = Target(view, (picture.to(render.maps.need("color")) / 255))
        weights = {name: loss.weight_at(index, index) for name, loss in LOSSES.items()}
        losses, total, _ = loss_gradients(LOSSES, LossGradient(), weights, render.maps, target, None)
        require_finite_losses(index, view.name, losses)
        if len(inner):
            grads = pulled(shape, render.backward(total), leaves)
            moved = torch.cat([grad.reshape(len(inner), -1) for grad in grads.values()], 1).any(1)  # the others rest
            adam_step(self.points, {n: grad[moved] for n, grad in grads.items()}, RATES, index, inner[moved])
            require_finite_values(index, view.name, self.points.params)
        return sum(losses.values())

    def shown(self, cut: Cut, rows: Tensor, inner: Tensor, leaves: Columns) -> Splats:
        """The splats of a cut.

        Args:
            cut: Of the tree.
            rows: (R,) int64 nodes and parents of it, sorted.
            inner: Which inner nodes the last of these are.
            leaves: Columns of the inner nodes that have gradients, by name.
        """
        model = self.tree.levels[0]
        own, shared = rows[: len(rows) - len(inner)], model.primitive.shared()
        raw = {
            name: value
            if name in shared
            else torch.cat([value[own], leaves.get(name, self.points.params[name][inner])])
            for name, value in model.params.items()
        }
        splats = model.primitive.activate(raw, model.sh_degree)
        node, parent = (splats.take(torch.searchsorted(rows, each)) for each in (cut.nodes, cut.parents))
        return self.tree.between(cut, node, parent)
