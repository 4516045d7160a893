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


@dataclass(frozen=True)
class InView:
    """R of N points.

    Attributes:
        rows: (R,) int64, in their order.
        splats: All N splats, detached, in the colours of degree 0.
    """

    rows: Tensor
    splats: Splats

    @classmethod
    @torch.no_grad()
    def of(cls, primitive: Primitive, params: Columns, camera: Camera, rasterizer: Rasterizer, near: float) -> InView:
        """The points that may touch a pixel of a view."""
        splats = primitive.activate(params, 0)
        return cls(true_rows(rasterizer.in_view(splats, camera, near)), splats)

    def of_columns(self, columns: Columns) -> Columns:
        """(R, ...) of each of (N, ...)."""
        return {name: value.index_select(0, self.rows) for name, value in columns.items()}

    def among_all(self, values: Tensor) -> Tensor:
        """(N, ...) of (R, ...), 0 for the points that are not in view."""
        found = values.new_zeros(len(self.splats), *values.shape[1:])
        return found.index_copy_(0, self.rows, values)


def true_rows(mask: Tensor) -> Tensor:
    """(R,) int64 indices of the true values of (N,) bool; on a CPU numpy finds them in an eighth of torch's time."""
    if mask.device.type == "cpu":
        return torch.from_numpy(np.flatnonzero(mask.numpy()))
    return mask.nonzero()[:, 0]
