"""The crop volume that the photographs allow: where enough of them show the truth."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from surfkit.core.check import BadInput
from surfkit.evaluate.geometry.outline import outline
from surfkit.evaluate.geometry.point_visibility import visible_counts
from surfkit.evaluate.geometry.scores import surface_gap, tree
from surfkit.evaluate.geometry.surface_file import BLOCK_POINTS, BOX_PIECES, SurfaceFile, part_within
from surfkit.evaluate.geometry.transform import apply, scale_of, seen_from
from surfkit.io.area import Area
from surfkit.scene.crop import PLANES, Axis, Crop, within
from surfkit.scene.scene import Frame, View

ALPHA_RADIUS_SHARE = 0.02
"""Of the alpha shape, as a share of the diagonal of the visible ground: half of the paper's 50 m on a square kilometre,
as holes are filled here."""


@dataclass(frozen=True)
class CropSettings:
    """What a point must be seen by to count, and what the volume around such points is.

    Attributes:
        visible: Views: a share of all up to 1, or their number.
        axis: That stands on the ground.
        radius: Of the alpha shape, units of the truth; a share of the diagonal if None.
        margin: Added below and above, so that noise on the lowest ground is not cut off.
    """

    visible: float
    axis: Axis
    radius: float | None
    margin: float


def visible_crop(
    truth: np.ndarray, views: Sequence[View], frame: Frame, matrix: np.ndarray, settings: CropSettings
) -> tuple[Crop, int]:
    """The volume around the points of the truth that enough views show, and how many points that are.

    Args:
        truth: (n, 3) frame of the truth.
        views: Training views.
        frame: Of the views.
        matrix: (4, 4) from the input frame of the views to that of the truth.
        settings: What counts as visible.
    """
    here = apply(np.linalg.inv(matrix), truth)
    gap = surface_gap(tree(truth), truth[:: max(1, len(truth) // 100_000)]) / scale_of(matrix)
    counts = visible_counts(here, views, frame, gap)
    least = max(1, math.ceil(settings.visible * (len(views) if settings.visible <= 1 else 1)))
    kept = truth[counts >= least]
    if len(kept) < 3:
        raise BadInput(
            f"--crop auto: {len(kept)} of {len(truth)} points of the truth are seen by {least} or more of {len(views)} "
            f"views (the best one by {counts.max(initial=0)}); the truth spans {extent_text(here)}, for the "
            f"cameras, and these {extent_text(centres(views, frame))}: lower --visible, or give --transform if "
            "the truth is in another frame or unit"
        )
    along = kept[:, "xyz".index(settings.axis)]
    ground = kept[:, list(PLANES[settings.axis])]
    radius = settings.radius or max(ALPHA_RADIUS_SHARE * float(np.linalg.norm(np.ptp(ground, axis=0))), 1e-9)
    low, high = float(along.min()) - settings.margin, float(along.max()) + settings.margin
    return Crop(outline(ground, radius), low, high, settings.axis), len(kept)


def heightened(
    crop: Crop, reconstruction: SurfaceFile, matrix: np.ndarray, room: float, area: Area | None = None
) -> Crop:
    """The volume as high and as deep as a reconstruction reaches above and below the polygon.

    Else nobody would see a false surface below the truth, or above it. What lies farther away than the volume is wide,
    as a sky does, stays outside.

    Args:
        crop: That the truth fills.
        reconstruction: In its own frame.
        matrix: (4, 4) from that frame to that of the truth.
        room: Added below and above.
        area: What counts of the volume, frame of the truth.
    """
    low, high, axis = crop.low, crop.high, "xyz".index(crop.axis)
    wide = float(np.linalg.norm(np.ptp(crop.polygon, axis=0)))
    for block in _reaching(reconstruction, matrix, replace(crop, low=low - wide, high=high + wide)):
        moved = apply(matrix, block)
        moved = moved[(moved[:, axis] > crop.low - wide) & (moved[:, axis] < crop.high + wide)]
        along = moved[_over(crop, area, moved), axis]
        low, high = min(low, along.min(initial=low)), max(high, along.max(initial=high))
    return replace(crop, low=low - room * (low < crop.low), high=high + room * (high > crop.high))


def _reaching(surface: SurfaceFile, matrix: np.ndarray, crop: Crop) -> Iterator[np.ndarray]:
    """(n, 3) places by which a surface reaches into a volume: its points, and the middles of the pieces of large faces,
    which may go through the volume without a corner in it, as the closing faces of Poisson surfaces do."""
    yield from surface.blocks()
    if surface.faces is None:
        return
    low, high = crop.ends
    low, high = seen_from(np.linalg.inv(matrix), (low, high))
    size = float(np.linalg.norm(high - low)) / BOX_PIECES
    for start in range(0, len(surface.faces), BLOCK_POINTS):
        faces = np.asarray(surface.faces[start : start + BLOCK_POINTS])
        corners = surface.vertices(faces.ravel()).reshape(-1, 3, 3)
        large = faces[np.ptp(corners, axis=1).max(1) > size]
        if len(large):
            yield part_within(replace(surface, faces=large), low, high).rows.reshape(-1, 3, 3).mean(1)


def _over(crop: Crop, area: Area | None, points: np.ndarray) -> np.ndarray:
    """(n,) bool: which of (n, 3) points, frame of the truth, lie on the polygon of a volume, and in the area."""
    found = within(crop.polygon, points[:, list(PLANES[crop.axis])])
    return found if area is None else found & area.inside(points)


def outside_shares(
    reconstruction: SurfaceFile, matrix: np.ndarray, crop: Crop, area: Area | None = None
) -> dict[str, float]:
    """Shares of a reconstruction that lie outside of a volume: above it, below it, and beside it or the area.

    Of the area of a mesh, each triangle by its centre, or of the points of a cloud.

    Args:
        reconstruction: In its own frame.
        matrix: (4, 4) from that frame to that of the truth.
        crop: The volume.
        area: What counts of it, frame of the truth.
    """
    axis, whole = "xyz".index(crop.axis), 0.0
    found = {"above": 0.0, "below": 0.0, "beside": 0.0}
    for points, weights in _weighted(reconstruction):
        moved = apply(matrix, points)
        inside = _over(crop, area, moved)
        parts = (inside & (moved[:, axis] > crop.high), inside & (moved[:, axis] < crop.low), ~inside)
        for name, part in zip(found, parts, strict=True):
            found[name] += float(weights[part].sum())
        whole += float(weights.sum())
    return {name: share / whole if whole else 0.0 for name, share in found.items()}


def _weighted(surface: SurfaceFile) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """(n, 3) places and (n,) weights: centres and areas of triangles, or points that weigh the same."""
    if surface.faces is None:
        yield from ((block, np.ones(len(block))) for block in surface.blocks())
        return
    for start in range(0, len(surface.faces), BLOCK_POINTS):
        corners = surface.vertices(np.asarray(surface.faces[start : start + BLOCK_POINTS]).ravel()).reshape(-1, 3, 3)
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        yield corners.mean(1), np.linalg.norm(normals, axis=1) / 2


def centres(views: Sequence[View], frame: Frame) -> np.ndarray:
    """(V, 3) float64 places of the cameras, input frame."""
    return frame.to_input(np.stack([view.camera.centre.numpy() for view in views]))


def extent_text(points: np.ndarray) -> str:
    """The box of (n, 3) points in a few words."""
    return " x ".join(f"[{low:.6g}, {high:.6g}]" for low, high in zip(points.min(0), points.max(0), strict=True))
