"""Initial points where no depth is trusted: on the surfaces that close what trusted depth sees into."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress

import numpy as np
import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.events import Progress, Warned, emit
from surfkit.scene.camera import Camera
from surfkit.scene.up_direction import map_axes, up_direction
from surfkit.start.base import StartInput
from surfkit.start.carve import Grid, meet, solid_of, votes
from surfkit.start.voxels import Collected, Samples, Thinned, thin_to

TRUSTED = 0.375
"""Least confidence of a depth that sees a surface, and through what lies before it."""
VOXEL = 0.5
"""Side of a voxel, as a share of the distance between points."""
STEP = 2
"""Every second pixel of every second row looks for a surface."""
APART = 0.75
"""Share of the distance between points from which a point of depth maps is so near that no other is needed."""


def closing_points(known: StartInput, stereo: Thinned, unsure: Callable[[int], Tensor | None], most: int) -> Thinned:
    """Points on the surfaces that close the space which trusted depth sees into, `most` at most.

    Args:
        known: What the start is given, with priors.
        stereo: Points of the depth maps; none is made close to one.
        unsure: (H, W) bool by position of the training view: pixels without a point, which look for a surface; None
            where there are none.
        most: Points.
    """
    nothing = Thinned(*np.zeros((3, 0, 3)), *np.zeros((2, 0)))
    count = len(known.priors or ())
    if most < 1 or not len(stereo) or not any(found is not None and found.any() for found in map(unsure, range(count))):
        return nothing
    spacing = float(np.median(stereo.size))
    up = up_direction(None, known.scene.train, known.scene.frame, np.eye(4)).direction
    grid = Grid.around(stereo.xyz, map_axes(up), VOXEL * spacing)
    solid = solid_of(votes(grid, trusted_maps(known)))
    side = grid.side / VOXEL
    if side > 1.01 * spacing:
        emit(
            Warned(
                f"the scene is large: where no depth is trusted, initial points are {side / spacing:.1f} times as far "
                "apart as elsewhere"
            )
        )
    collected = Collected(side, max(1 << 20, 6 * most))
    for at in range(count):
        where = unsure(at)
        if where is not None and where.any():
            with suppress(BadInput):  # a damaged photograph: training passes over it too, and tells
                collected.add(seen_from(grid, solid, known.scene.train[at].camera, where, known.photos[at]))
        emit(Progress("closing what depth maps see into", at + 1, count))
    points = thin_to(collected.settle(), most)
    return points.take(away_from(points.xyz, stereo.xyz, APART * side)) if len(points) else nothing


def trusted_maps(known: StartInput) -> Iterator[tuple[Camera, Tensor]]:
    """Cameras of the depth maps, and (H, W) depths, 0 where they are not trusted."""
    for at, prior in enumerate(known.priors or ()):
        if prior is not None:
            there = (prior.inverse > 0) & (prior.confidence >= TRUSTED)
            if known.masks is not None and known.masks[at] is not None:
                there &= known.masks[at]
            camera, (height, width) = known.scene.train[at].camera, prior.inverse.shape
            yield camera.resized(width, height), torch.where(there, 1 / prior.inverse.clamp_min(1e-20), 0.0)
        emit(Progress("seeing through space", at + 1, len(known.priors or ())))


def seen_from(grid: Grid, solid: np.ndarray, camera: Camera, where: Tensor, photo: Tensor) -> Samples:
    """What some of the pixels of a view meet in a grid, with their colours."""
    some = torch.zeros_like(where)
    some[::STEP, ::STEP] = where[::STEP, ::STEP]
    rays = camera.rays(torch.float64)[:, some].T.numpy()
    depth, normals = meet(grid, solid, camera, rays)
    met = depth > 0
    turn, shift = camera.world_to_camera[:3, :3].numpy(), camera.world_to_camera[:3, 3].numpy()
    toward = -(rays / np.linalg.norm(rays, axis=1, keepdims=True)) @ turn
    facing = np.where(np.abs(normals).sum(1, keepdims=True) > 0, normals, toward)
    return Samples(
        xyz=((rays * depth[:, None] - shift) @ turn)[met],
        rgb=photo[:, some].T.float().numpy()[met],
        normals=facing[met],
        weight=np.ones(int(met.sum()), np.float32),
        grain=np.full(int(met.sum()), grid.side),
    )


def away_from(points: np.ndarray, others: np.ndarray, distance: float) -> np.ndarray:
    """(P,) bool: points with none of the others within a distance."""
    from scipy.spatial import cKDTree

    return ~np.isfinite(cKDTree(others).query(points, distance_upper_bound=distance)[0])
