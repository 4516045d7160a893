"""Views by the part of their picture that the space of a block fills."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.events import Progress, emit
from surfkit.partition.assign import Assign, check_threshold, inside
from surfkit.partition.base import Cells, CoarseModel, Ground
from surfkit.scene.camera import Camera

RAYS_PER_SIDE = 48
"""Rays along each side of a picture."""
MIN_CONTAINED_SHARE = 0.99
"""Share of a block's points, along each axis, that its space must hold."""
MIN_RAY_SLOPE = 1e-12
"""A ray rises at least this much along each axis of the ground, per unit of depth."""


@dataclass(frozen=True)
class Airspace(Assign):
    """The part of the picture that the block fills with its air, from ground to highest point (VastGaussian, sec. 3.2).

    What stands in front does not count, nor whether anything is there to be seen: a view that looks through the air
    above a block keeps that air empty. Cameras inside the space, seen from above, always join.
    """

    threshold: float = 0.25
    """Part of the picture with which a view joins."""

    growth: float = 0.2
    """How much longer and wider than the block its space is, as a share of the block."""

    def __post_init__(self) -> None:
        check_threshold(self.threshold, "airspace")
        if not 0 <= self.growth < float("inf"):
            raise BadInput(f"assign: airspace.growth is {self.growth}; it must be 0 or more")

    def joins(self, sight: CoarseModel, cells: Cells) -> Tensor:
        """See `Assign.joins`; those with their camera inside always join."""
        owner = cells.owner(sight.splats.means)
        return inside(sight, cells) | (self.measure(sight, owner, cells.count) > self.threshold)

    def measure(self, sight: CoarseModel, owner: Tensor, count: int) -> Tensor:
        """(V, B) the share of a view that the space of each of `count` blocks fills, by rays; 1 for a camera in it.

        `owner` is the block of each splat, (N,).
        """
        axes = Ground.under(sight.centres, sight.splats.means).axes
        places, spaces = sight.splats.means.double() @ axes.T, {}
        for block in owner[owner >= 0].unique().tolist():
            spaces[block] = self._space(places[owner == block])
        share = torch.zeros(len(sight.views), count)
        for at, view in enumerate(sight.views):
            for block, (low, high) in spaces.items():
                share[at, block] = filled(view.camera, axes, low, high)
            emit(Progress("assigning views", at + 1, len(sight.views)))
        return share

    def _space(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """(3,) lower and upper corner, along the axes of the ground, of what holds (N, 3) places."""
        ranked = places.sort(0).values
        cut = int((1 - MIN_CONTAINED_SHARE) / 2 * len(ranked))
        low, high = ranked[cut], ranked[len(ranked) - 1 - cut]
        margin = self.growth / 2 * (high - low) * torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)
        return low - margin, high + margin


def filled(camera: Camera, axes: Tensor, low: Tensor, high: Tensor) -> float:
    """The part of a picture that a box fills; 1 if the camera is inside, above or below it.

    Args:
        camera: With its world in the local frame.
        axes: (3, 3) float64, the axes of the ground in rows.
        low: (3,) float64 lower corner of the box along these axes.
        high: (3,) upper corner.
    """
    eye = axes @ camera.centre
    if ((eye >= low) & (eye <= high))[:2].all():
        return 1.0
    rays = camera.resized(RAYS_PER_SIDE, RAYS_PER_SIDE).rays(torch.float64).flatten(1)
    steps = axes @ camera.world_to_camera[:3, :3].T @ rays
    steps = torch.where(steps.abs() < MIN_RAY_SLOPE, MIN_RAY_SLOPE, steps)
    sides = torch.stack([low - eye, high - eye])[:, :, None] / steps
    enter, leave = sides.amin(0).amax(0), sides.amax(0).amin(0)
    return float(((leave > 0) & (enter <= leave)).double().mean())
