"""How many views see each point of the truth and of the reconstruction, and in how many it lies near a depth edge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from surfkit.core.events import Progress, emit
from surfkit.evaluate.geometry.point_visibility import DEPTH_LONGEST_PX, SQUARE_GAPS, cloud_depth, not_hidden, project
from surfkit.scene.scene import Frame, View

MIN_EDGE_STEP = 0.02
"""Share of the depth by which neighbouring pixels must differ for an edge to lie between them."""
MIN_EDGE_WIDTHS = 4.0
"""Widths of a point's square by which they must differ as well: slanted surfaces differ by less."""
EDGE_REACH_PX = 4
"""Pixels, of a picture 800 pixels long, within which a point is near an edge."""


@dataclass(frozen=True)
class Sightings:
    """What the views show of n points.

    Attributes:
        seen: (n,) int32 views in which the point lies in the picture and is not hidden by the truth.
        edges: (n,) int32 those of them in which it lies within a few pixels of a step in the depth of the truth.
    """

    seen: np.ndarray
    edges: np.ndarray


def sightings(
    clouds: tuple[np.ndarray, np.ndarray], views: Sequence[View], frame: Frame, gap: float
) -> tuple[Sightings, Sightings]:
    """What the views show of the truth and of other points; the truth alone hides either.

    Args:
        clouds: (m, 3) of the truth and (n, 3) others, float64 input frame.
        views: With cameras in the local frame.
        frame: Of the views.
        gap: Between points of the truth, input units: 1 / sqrt(points per area).
    """
    truth, others = (Sightings(*(np.zeros(len(points), np.int32) for _ in range(2))) for points in clouds)
    for done, view in enumerate(views, 1):
        camera = view.camera.sized(DEPTH_LONGEST_PX)
        pose = frame.input_pose(camera.world_to_camera)
        depth, spots = cloud_depth(clouds[0], camera, pose, gap)
        near = near_edges(depth, gap)
        for of, (at, x, y, z) in zip((truth, others), (spots, project(clouds[1], camera, pose)), strict=True):
            seen = not_hidden(depth, (at, x, y, z), gap, camera)
            of.seen[at[seen]] += 1
            of.edges[at[seen & near[y, x]]] += 1
        emit(Progress("counting the views of each class", done, len(views)))
    return truth, others


def near_edges(depth: np.ndarray, gap: float) -> np.ndarray:
    """(H, W) bool: pixels within a few pixels of a step in an (H, W) depth map, inf where nothing is known.

    The border of what is known is no edge: the truth may end there, and the scene not.
    """
    from scipy import ndimage

    edge = np.zeros(depth.shape, bool)
    known = np.isfinite(depth)
    value = np.where(known, depth, 0.0)
    for axis in (0, 1):
        here, there = ((slice(None),) * axis + (part,) for part in (slice(None, -1), slice(1, None)))
        nearer = np.minimum(value[here], value[there])
        step = np.abs(value[here] - value[there]) > np.maximum(
            MIN_EDGE_STEP * nearer, MIN_EDGE_WIDTHS * SQUARE_GAPS * gap
        )
        step &= known[here] & known[there]
        edge[here] |= step
        edge[there] |= step
    return ndimage.maximum_filter(edge, size=2 * EDGE_REACH_PX + 1)
