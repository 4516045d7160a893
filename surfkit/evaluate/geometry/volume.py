"""The crop volume that the photographs allow: where enough of them show the truth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from surfkit.core.check import BadInput
from surfkit.evaluate.geometry.outline import outline
from surfkit.evaluate.geometry.scores import surface_gap, tree
from surfkit.evaluate.geometry.transform import apply, scale_of
from surfkit.evaluate.geometry.visibility import visible_counts
from surfkit.scene.crop import PLANES, Axis, Crop
from surfkit.scene.scene import Frame, View

RADIUS = 0.02
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
    radius = settings.radius or max(RADIUS * float(np.linalg.norm(np.ptp(ground, axis=0))), 1e-9)
    low, high = float(along.min()) - settings.margin, float(along.max()) + settings.margin
    return Crop(outline(ground, radius), low, high, settings.axis), len(kept)


def centres(views: Sequence[View], frame: Frame) -> np.ndarray:
    """(V, 3) float64 places of the cameras, input frame."""
    return frame.to_input(np.stack([view.camera.centre.numpy() for view in views]))


def extent_text(points: np.ndarray) -> str:
    """The box of (n, 3) points in a few words."""
    return " x ".join(f"[{low:.6g}, {high:.6g}]" for low, high in zip(points.min(0), points.max(0), strict=True))
