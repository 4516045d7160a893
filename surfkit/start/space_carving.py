"""Initial points where no depth is trusted: depth that nothing contradicts, and what closes the space seen into."""

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
from surfkit.start.carving_grid import CarvingGrid, Votes, meet, solid_of, votes
from surfkit.start.depth_points import points_of
from surfkit.start.voxels import Samples, Thinned, VoxelAccumulator, thin

MIN_SEEING_CONFIDENCE = 0.375
"""Least confidence of a depth that sees a surface, and through what lies before it."""
VOXEL_SPACING_SHARE = 0.5
"""Side of a voxel, as a share of the distance between points."""
MIN_UNTRUSTED_PIXELS = 2
"""Depth that is not trusted makes a point where so many pixels have it, of one view or more."""
PIXEL_STRIDE = 2
"""Every second pixel of every second row looks for a surface that closes what is seen into."""
MIN_SPACING_SHARE = 0.75
"""Share of the distance between points from which another point is so near that none is needed."""


def closing_points(known: StartInput, stereo: Thinned, unsure: Callable[[int], Tensor | None], most: int) -> Thinned:
    """Points where no depth is trusted, none of them close to another or to one of the depth maps.

    They lie at depth that is not trusted, if trusted depth does not see through it; and on the surfaces that close the
    space which trusted depth sees into.

    Args:
        known: What the start is given, with priors.
        stereo: Points of the depth maps.
        unsure: (H, W) bool by position of the training view: pixels without a point; None where there are none.
        most: Points; if there are more, those stay that most pixels see, and it is told.
    """
    count = len(known.priors or ())
    if not len(stereo) or not any(where is not None and where.any() for where in map(unsure, range(count))):
        return Thinned.none()
    if most < 1:
        emit(Warned("no initial points where no depth is trusted: start.points or start.most allows no more points"))
        return Thinned.none()
    spacing = float(np.median(stereo.size))
    up = up_direction(None, known.scene.train, known.scene.frame, np.eye(4)).direction
    grid = CarvingGrid.around(stereo.xyz, map_axes(up), VOXEL_SPACING_SHARE * spacing)
    found = votes(grid, trusted_maps(known))
    solid, side = solid_of(found), grid.side / VOXEL_SPACING_SHARE
    if side > 1.01 * spacing:
        emit(
            Warned(
                f"the scene is large: where no depth is trusted, initial points are {side / spacing:.1f} times as far "
                "apart as elsewhere"
            )
        )
    untrusted, closing = (VoxelAccumulator.for_points(side, most) for _ in range(2))
    for at, prior in enumerate(known.priors or ()):
        where = unsure(at)
        if where is not None and prior is not None and where.any():
            with suppress(BadInput):  # a damaged photograph: training passes over it too, and tells
                camera, photo = known.scene.train[at].camera, known.photos[at]
                guesses = points_of(camera, prior, photo, where & (prior.inverse > 0))
                untrusted.add(not_seen_through(grid, found, guesses))
                closing.add(seen_from(grid, solid, camera, where, photo))
        emit(Progress("points where no depth is trusted", at + 1, count))
    first, second = (thin(voxels, voxels.side) for voxels in (untrusted.settle(), closing.settle()))
    first = first.take(
        (first.weight >= MIN_UNTRUSTED_PIXELS) & away_from(first.xyz, stereo.xyz, MIN_SPACING_SHARE * side)
    )
    second = second.take(away_from(second.xyz, np.concatenate([stereo.xyz, first.xyz]), MIN_SPACING_SHARE * side))
    return most_seen(first.joined(second), most)


def most_seen(points: Thinned, most: int) -> Thinned:
    """The points that most pixels see, `most` at most; it is told if that are not all."""
    if len(points) <= most:
        return points
    emit(
        Warned(
            f"of {len(points):,} initial points where no depth is trusted, {most:,} are used: start.points or "
            "start.most allows no more"
        )
    )
    return points.take(np.sort(np.argsort(-points.weight, kind="stable")[:most]))


def trusted_maps(known: StartInput) -> Iterator[tuple[Camera, Tensor]]:
    """Cameras of the depth maps, and (H, W) depths, 0 where they are not trusted."""
    for at, prior in enumerate(known.priors or ()):
        if prior is not None:
            there = (prior.inverse > 0) & (prior.confidence >= MIN_SEEING_CONFIDENCE)
            mask = None if known.masks is None else known.masks[at]
            if mask is not None:
                there &= mask
            camera, (height, width) = known.scene.train[at].camera, prior.inverse.shape
            yield camera.resized(width, height), torch.where(there, 1 / prior.inverse.clamp_min(1e-20), 0.0)
        emit(Progress("seeing through space", at + 1, len(known.priors or ())))


def not_seen_through(grid: CarvingGrid, found: Votes, points: Samples) -> Samples:
    """The points that no more trusted depth maps see through than see a surface there; a pixel has a weight of 1."""
    (i, j, k), inside = grid.voxels_of(points.xyz)
    keep = inside & (found.through[i, j, k] <= found.surfaces[i, j, k])
    count = int(keep.sum())
    return Samples(
        points.xyz[keep],
        points.rgb[keep],
        points.normals[keep],
        weight=np.ones(count, np.float32),
        grain=np.full(count, grid.side),
    )


def seen_from(grid: CarvingGrid, solid: np.ndarray, camera: Camera, where: Tensor, photo: Tensor) -> Samples:
    """What some of the pixels of a view meet in a grid, with their colours."""
    some = torch.zeros_like(where)
    some[::PIXEL_STRIDE, ::PIXEL_STRIDE] = where[::PIXEL_STRIDE, ::PIXEL_STRIDE]
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
        weight=np.full(int(met.sum()), PIXEL_STRIDE**2, np.float32),
        grain=np.full(int(met.sum()), grid.side),
    )


def away_from(points: np.ndarray, others: np.ndarray, distance: float) -> np.ndarray:
    """(P,) bool: points with none of the others within a distance."""
    from scipy.spatial import cKDTree

    return ~np.isfinite(cKDTree(others).query(points, distance_upper_bound=distance)[0])
