"""The colours that photographs show sparse points in, and how the photographs stand."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates

from surfkit.core.check import BadInput
from surfkit.core.events import Progress, emit
from surfkit.scene.observations import Observations
from surfkit.scene.photos import read_draft
from surfkit.scene.response import sensor_scale
from surfkit.scene.scene import View

PHASE = "comparing the light of photographs"
DRAFT_SIDE_PX = 256
"""Longer side at which photographs are read, pixels, or up to twice that: the colour of a place is a mean around it."""
MAX_POINTS_PER_PHOTO, MAX_SIGHTS = 300, 3_000_000
"""On average, and of all photographs, of which a million take 1.3 GB; other points are left out, chosen at random."""


@dataclass(frozen=True)
class TrackColors:
    """Colours of sparse points in photographs, K of them.

    Attributes:
        photo: (K,) int64, the photograph.
        point: (K,) int64, the number of the point.
        place: (K, 2) float64 x and y on the sensor, from the principal point, in halves of the picture's diagonal.
        color: (K, 3) float64 sRGB in [0, 1].
    """

    photo: np.ndarray
    point: np.ndarray
    place: np.ndarray
    color: np.ndarray


def track_colors(views: Sequence[View], tracks: Observations) -> TrackColors:
    """Colours of the sparse points that two photographs and more show; a photograph that cannot be read shows none."""
    shown = [tracks.seen.get(view.name) for view in views]
    different = (np.unique(one.points) for one in shown if one is not None)  # a track may hold a photograph twice
    counts = sum((np.bincount(points, minlength=len(tracks.xyz)) for points in different), start=0)
    kept = np.flatnonzero(np.asarray(counts) > 1)
    total, most = int(np.asarray(counts)[kept].sum()), min(MAX_POINTS_PER_PHOTO * len(views), MAX_SIGHTS)
    if total > most:
        kept = np.sort(np.random.default_rng(0).permutation(kept)[: len(kept) * most // total])
    rows = np.full(len(tracks.xyz), -1)
    rows[kept] = np.arange(len(kept))

    def look(at: int) -> tuple[np.ndarray, ...] | None:
        one, camera = shown[at], views[at].camera
        if one is None:
            return None
        some = (rows[one.points] >= 0) & ((one.at > 0) & (one.at < 1)).all(1)
        try:
            pixels = read_draft(views[at].path, DRAFT_SIDE_PX, views[at].pixels)
        except BadInput:  # told where it is trained on
            return None
        share = one.at[some]
        height, width = pixels.shape[:2]
        spots = (share[:, 1] * height - 0.5, share[:, 0] * width - 0.5)
        colors = [map_coordinates(pixels[..., c].astype(np.float64), spots, order=1, mode="nearest") for c in range(3)]
        place = (share * (camera.width, camera.height) - (camera.cx, camera.cy)) * sensor_scale(camera)
        return np.full(len(share), at), rows[one.points[some]], place, np.stack(colors, 1) / 255

    found = []
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        for done, one in enumerate(pool.map(look, range(len(views))), 1):
            emit(Progress(PHASE, done, len(views)))
            found += [one] if one is not None else []
    if not found:
        return TrackColors(
            *(np.zeros(shape, kind) for shape, kind in (((0,), int), ((0,), int), ((0, 2), float), ((0, 3), float)))
        )
    return TrackColors(*(np.concatenate(each) for each in zip(*found, strict=True)))


def rows_of(views: Sequence[View]) -> np.ndarray:
    """(V,) int64, the camera that took each view: cameras are numbered in the order of their first views."""
    names = {name: row for row, name in enumerate(dict.fromkeys(view.taken_by for view in views))}
    return np.array([names[view.taken_by] for view in views], np.int64)


def sensor_axes(rotation: np.ndarray, focal: Sequence[float], scale: float) -> np.ndarray:
    """(3, 2) what turns a place on the sensor into how far a sight leads aside of the optical axis, in the world, as a
    share of the way along it.

    Args:
        rotation: (3, 3) of world_to_camera.
        focal: Focal lengths along x and y, pixels.
        scale: See `scene.response.sensor_scale`.
    """
    return rotation[:2].T / (np.asarray(focal) * scale)


def axes_of(views: Sequence[View]) -> np.ndarray:
    """(V, 3, 2) `sensor_axes` of views."""
    cameras = [view.camera for view in views]
    return np.stack(
        [sensor_axes(one.world_to_camera[:3, :3].numpy(), (one.fx, one.fy), sensor_scale(one)) for one in cameras]
    )
