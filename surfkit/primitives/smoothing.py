"""The 3D smoothing filter of Mip-Splatting (Yu et al. 2024, section 5.1)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.schedule import LearningRate
from surfkit.primitives.base import Primitive
from surfkit.primitives.columns import SIGMOID, Column, standard_columns
from surfkit.primitives.points import Columns
from surfkit.scene.camera import Camera

INTERVAL = "interval"
"""Column with the sampling interval of each point: its smallest distance between pixels in any training view."""
MAX_PREFILTER_OPACITY = 0.9999
"""Opacity before the filter that can be asked for: after it, that of a small splat is lower."""
MAX_OUTSIDE_SHARE = 0.15
"""A point this share of an image beside it still counts as seen, as its footprint may reach in."""


@dataclass(frozen=True)
class Smoothable:
    """The part of a primitive that keeps its splats as large as what the training photographs can tell apart.

    It stands before `Primitive` among the bases of a class.
    """

    smoothing: float = 0.0
    """Variance of a 3D smoothing filter, in squares of the smallest distance between pixels that any training view has
    at a point (Mip-Splatting: 0.2); 0 is no filter. No splat becomes thinner than that, which would show from nearer;
    opacities fall so that a splat's integral over its axes stays the same. Files of splats hold what is drawn."""

    def __post_init__(self) -> None:
        Primitive.__post_init__(self)  # type: ignore[arg-type]  # a class has both as bases
        if not 0 <= self.smoothing < float("inf"):
            raise BadInput(f"primitive.smoothing is {self.smoothing:g}; it must be 0 or more")

    def observed(self, params: Columns, cameras: Sequence[Camera], near: float) -> Columns:
        """The sampling intervals, if scales are smoothed."""
        return {INTERVAL: sampling_intervals(params["means"], cameras, near)} if self.smoothing else {}

    def with_opacities(self, params: Columns, opacities: Tensor) -> Columns:
        """See `Primitive.with_opacities`: `opacities` are those after the filter, as far as there are such."""
        if self.smoothing:
            opacities = (opacities / self._kept(params).detach()).clamp_max(MAX_PREFILTER_OPACITY)
        return Primitive.with_opacities(self, params, opacities)  # type: ignore[arg-type]

    def smoothable_columns(self, axes: int) -> dict[str, Column]:
        """The standard columns, and the sampling intervals if scales are smoothed: (), local units, not trained."""
        added = {INTERVAL: Column((), LearningRate(0.0))} if self.smoothing else {}
        return standard_columns(axes, self.sh_degree) | added  # type: ignore[attr-defined]

    def unobserved(self, count: int) -> Columns:
        """The sampling intervals of new points, if scales are smoothed: 0, until `observed` knows better."""
        return {INTERVAL: torch.zeros(count)} if self.smoothing else {}

    def filtered(self, params: Columns) -> tuple[Tensor, Tensor]:
        """Scales and opacities after the filter, if there is one."""
        scales, opacities = params["scales"].exp(), SIGMOID.value(params["opacities"])
        if not self.smoothing:
            return scales, opacities
        return smoothed(scales, params[INTERVAL].detach(), self.smoothing), opacities * self._kept(params)

    def _kept(self, params: Columns) -> Tensor:
        return kept_share(params["scales"].exp(), params[INTERVAL].detach(), self.smoothing)


def sampling_intervals(means: Tensor, cameras: Sequence[Camera], near: float) -> Tensor:
    """(N,) the smallest z / focal length over the cameras that a point is in front of and in the image of.

    What hides a point is not looked at. A point that no camera sees has the largest interval of those that are seen.

    Args:
        means: (N, 3) local units.
        cameras: Of the training views.
        near: Points nearer to a camera do not count; local units.
    """
    smallest = torch.full_like(means[:, 0], torch.inf)
    for camera in cameras:
        pose = camera.world_to_camera.to(means)
        x, y, z = (means @ pose[:3, :3].T + pose[:3, 3]).unbind(1)
        across = x / z * camera.fx + camera.cx, camera.width
        down = y / z * camera.fy + camera.cy, camera.height
        seen = z > near
        for at, size in (across, down):
            seen &= (at >= -MAX_OUTSIDE_SHARE * size) & (at <= (1 + MAX_OUTSIDE_SHARE) * size)
        smallest = torch.where(seen, torch.minimum(smallest, z / max(camera.fx, camera.fy)), smallest)
    known = smallest.isfinite()
    largest = smallest[known].max() if known.any() else smallest.new_zeros(())
    return torch.where(known, smallest, largest)


def kept_share(scales: Tensor, interval: Tensor, variance: float) -> Tensor:
    """(N,) share of its opacity that a point keeps, so that its integral over its axes stays the same.

    Args:
        scales: (N, 2) or (N, 3) before the filter, local units.
        interval: (N,) local units.
        variance: Of the filter, in squared intervals.
    """
    return (scales / smoothed(scales, interval, variance)).prod(-1)


def smoothed(scales: Tensor, interval: Tensor, variance: float) -> Tensor:
    """(N, 2) or (N, 3) scales after the filter: sqrt(s^2 + variance interval^2)."""
    return (scales**2 + variance * interval[:, None] ** 2).sqrt()
