"""The points that a step is for, where it leaves out those that its view does not show."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from surfkit.core.registry import name_of
from surfkit.primitives.base import Primitive
from surfkit.primitives.drawing import draws_itself
from surfkit.primitives.points import Columns, Points
from surfkit.raster.api import Splats
from surfkit.raster.base import Rasterizer
from surfkit.scene.camera import Camera
from surfkit.train.point_blocks import SORTED_EVERY, PointBlocks, put_in_order
from surfkit.train.setup import StageSetup
from surfkit.train.stage import Stage
from surfkit.train.state import StageState


@dataclass(frozen=True)
class PointsInView:
    """R of N points.

    Attributes:
        rows: (R,) int64, in their order.
        count: N.
    """

    rows: Tensor
    count: int

    @classmethod
    @torch.no_grad()
    def of(
        cls,
        primitive: Primitive,
        params: Columns,
        camera: Camera,
        rasterizer: Rasterizer,
        near: float,
        blocks: PointBlocks | None = None,
    ) -> PointsInView:
        """The points that may touch a pixel of a view; with their `blocks`, only those that it may show are opened."""
        some = blocks.rows(rasterizer, camera, near) if blocks is not None else None
        if some is None:
            rows = true_rows(rasterizer.in_view(primitive.activate(params, 0), camera, near))
        else:
            near_by = primitive.activate(without_harmonics(params, some), 0)
            rows = some[true_rows(rasterizer.in_view(near_by, camera, near))]
        return cls(rows, len(params["means"]))

    @classmethod
    def of_step(cls, setup: StageSetup, state: StageState, camera: Camera) -> PointsInView | None:
        """The points that the coming step is for; None where it is for all (`Optimizer.in_view`)."""
        stage = setup.stage
        if not stage.optimizer.in_view or stage.regularizers or stage.is_paired(state.index + 1):
            return None  # regularizers and second views look at other points too
        if setup.draws is not setup.rasterizer or state.points.shared:
            return None
        blocks = current_blocks(setup, state)
        return cls.of(setup.primitive, state.points.params, camera, setup.rasterizer, stage.near, blocks)

    def of_columns(self, columns: Columns) -> Columns:
        """(R, ...) of each of (N, ...); the columns themselves where all points are in view."""
        if len(self.rows) == self.count:
            return columns
        return {name: value.index_select(0, self.rows) for name, value in columns.items()}

    def among_all(self, values: Tensor) -> Tensor:
        """(N, ...) of (R, ...), 0 for the points that are not in view."""
        found = values.new_zeros(self.count, *values.shape[1:])
        return found.index_copy_(0, self.rows, values)


def without_harmonics(columns: Columns, rows: Tensor) -> Columns:
    """(R, ...) of each of (N, ...), to see where splats are: of the harmonics beyond the first, three quarters of a
    point, those of one point stand for all."""
    return {
        name: value[:1].expand(len(rows), *value.shape[1:]) if name == "sh_rest" else value.index_select(0, rows)
        for name, value in columns.items()
    }


def current_blocks(setup: StageSetup, state: StageState) -> PointBlocks:
    """The blocks of the points as they are; the points are put in spatial order first where that is due.

    It is due every so many steps (and at each edit, `step.densify`), so that a run that goes on has the same order.
    """
    if state.index % SORTED_EVERY == 0:
        points, state.blocks = state.points.to_rearrange(), None  # which hold the columns
        put_in_order(points)
        state.points = points
    return blocks_of(setup, state)


def blocks_of(setup: StageSetup, state: StageState) -> PointBlocks:
    """The blocks of the points as they are."""
    if state.blocks is None or not state.blocks.are_of(state.points.params):
        state.blocks = PointBlocks.of(setup.primitive, state.points.params)
    return state.blocks


def shown_points(setup: StageSetup, state: StageState, camera: Camera, degree: int) -> tuple[Tensor, Splats]:
    """(R,) rows of the points that a view may show; and these, where the rasterizer draws, in the colours that they
    leave the stage with, and then those of the frozen ones. For a stage with steps for the points in view."""
    blocks = blocks_of(setup, state)
    in_view = PointsInView.of(setup.primitive, state.points.params, camera, setup.rasterizer, setup.stage.near, blocks)
    some = Points(on(setup.rasterizer.where(), in_view.of_columns(state.points.params)), {}, {})
    params = setup.stage.finished(replace(state, points=some))
    shape = setup.primitive.activate(params, degree)
    return in_view.rows, with_frozen(setup, state, shape, degree, camera)


def on(device: torch.device, columns: Columns) -> Columns:
    """Columns on a device."""
    return {name: value.to(device) for name, value in columns.items()}


def why_all(stage: Stage, primitive: Primitive) -> str | None:
    """What lets steps of a stage be for all points, by its name in the stage, and what to do; None where all steps are
    for the points in view."""
    if not stage.optimizer.in_view:
        return f"optimizer:{name_of(stage.optimizer)} is for all points; choose optimizer:adam-in-view"
    if stage.regularizers:
        return f"regularizers.{next(iter(stage.regularizers))} looks at all points; drop it"
    if pairs := [name for name, loss in stage.losses.items() if loss.needs_neighbour]:
        return f"losses.{pairs[0]} looks at two views; drop it"
    if primitive.shared() or draws_itself(primitive):
        return f"primitive {name_of(primitive)} is drawn as a whole; choose another"
    return None


@torch.no_grad()
def note_moved(setup: StageSetup, state: StageState, in_view: PointsInView) -> None:
    """Widen the bounds of blocks by their points in view, which have been updated."""
    if state.blocks is not None:
        moved = setup.primitive.activate(without_harmonics(state.points.params, in_view.rows), 0)
        state.blocks.widen(in_view.rows, moved)


def with_frozen(
    setup: StageSetup, state: StageState, shape: Splats, degree: int, camera: Camera | None = None
) -> Splats:
    """The splats of a state, detached, and then those that are frozen; of these, with a camera, those in view."""
    splats, frozen, where = shape.detached(), state.frozen, shape.means.device
    if not frozen:
        return splats
    if camera is not None:
        frozen = PointsInView.of(setup.primitive, frozen, camera, setup.rasterizer, setup.stage.near).of_columns(frozen)
    shared = {name: value.detach() for name, value in state.points.shared.items()}
    return splats.and_then(setup.primitive.activate(on(where, frozen | shared), degree))


def true_rows(mask: Tensor) -> Tensor:
    """(R,) int64 indices of the true values of (N,) bool; on a CPU numpy finds them in an eighth of torch's time."""
    if mask.device.type == "cpu":
        return torch.from_numpy(np.flatnonzero(mask.numpy()))
    return mask.nonzero()[:, 0]
