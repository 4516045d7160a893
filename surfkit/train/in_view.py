"""The points that a step is for, where it leaves out those that its view does not show."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from surfkit.primitives.base import Primitive
from surfkit.primitives.points import Columns
from surfkit.raster.api import Rasterizer, Splats
from surfkit.scene.camera import Camera
from surfkit.train.point_blocks import SORTED_EVERY, PointBlocks, put_in_order
from surfkit.train.setup import StageSetup
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
            near_by = {name: value.index_select(0, some) for name, value in params.items()}
            rows = some[true_rows(rasterizer.in_view(primitive.activate(near_by, 0), camera, near))]
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
        """(R, ...) of each of (N, ...)."""
        return {name: value.index_select(0, self.rows) for name, value in columns.items()}

    def among_all(self, values: Tensor) -> Tensor:
        """(N, ...) of (R, ...), 0 for the points that are not in view."""
        found = values.new_zeros(self.count, *values.shape[1:])
        return found.index_copy_(0, self.rows, values)


def current_blocks(setup: StageSetup, state: StageState) -> PointBlocks:
    """The blocks of the points as they are; the points are put in spatial order first where that is due.

    It is due every so many steps (and at each edit, `step.densify`), so that a run that goes on has the same order.
    """
    if state.index % SORTED_EVERY == 0:
        put_in_order(state.points)
    if state.blocks is None or not state.blocks.are_of(state.points.params):
        state.blocks = PointBlocks.of(setup.primitive, state.points.params)
    return state.blocks


@torch.no_grad()
def note_moved(setup: StageSetup, state: StageState, in_view: PointsInView) -> None:
    """Widen the bounds of blocks by their points in view, which have been updated."""
    if state.blocks is not None:
        moved = setup.primitive.activate(in_view.of_columns(state.points.params), 0)
        state.blocks.widen(in_view.rows, moved)


def with_frozen(
    setup: StageSetup, state: StageState, shape: Splats, degree: int, camera: Camera | None = None
) -> Splats:
    """The splats of a state, detached, and then those that are frozen; of these, with a camera, those in view."""
    splats, frozen = shape.detached(), state.frozen
    if not frozen:
        return splats
    if camera is not None:
        frozen = PointsInView.of(setup.primitive, frozen, camera, setup.rasterizer, setup.stage.near).of_columns(frozen)
    shared = {name: value.detach() for name, value in state.points.shared.items()}
    return splats.and_then(setup.primitive.activate(frozen | shared, degree))


def true_rows(mask: Tensor) -> Tensor:
    """(R,) int64 indices of the true values of (N,) bool; on a CPU numpy finds them in an eighth of torch's time."""
    if mask.device.type == "cpu":
        return torch.from_numpy(np.flatnonzero(mask.numpy()))
    return mask.nonzero()[:, 0]
