"""Choice of source photographs and of the depth range, from the sparse points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import csr_matrix

from surfkit.core.events import Progress, emit
from surfkit.scene.align import MAX_ERROR_PX, MIN_POINTS
from surfkit.scene.observations import Observations
from surfkit.scene.scene import View

NARROW, WIDE = 1 / 3, 1.5
"""Width of the weight of a pair below and above the preferred angle, as shares of that angle."""
SAME_SIDE = 0.8
"""Share of its weight that a view loses when another stands in the same direction: both see the same occlusions."""
LEAST = 0.1
"""A pair with a weight of fewer than this many well placed points is not compared."""
CANDIDATES = 40
"""Number of views, those with most shared points, whose angles are computed."""
OUTLIERS = 0.01
"""Share of the sparse points that may lie closer than the depths tried, and farther away."""


def neighbours(views: Sequence[View], observations: Observations, count: int, angle: float) -> list[list[int]]:
    """For each view, positions of up to `count` views to compare it with, best first.

    A pair is worth the sum over the points that both see of exp(-(a - angle)^2 / 2 s^2), where a is the angle between
    the two rays, and s is small below the best angle, which gives no parallax, and large above, where views differ.

    Args:
        views: V views.
        observations: Where they show sparse points.
        count: Of neighbours.
        angle: Between rays, degrees.
    """
    rows = [observations.seen[view.name].points if view.name in observations.seen else [] for view in views]
    ends = np.cumsum([0, *(len(row) for row in rows)])
    columns = np.concatenate([np.asarray(row, np.int64) for row in rows])
    sees = csr_matrix((np.ones(len(columns), np.int32), columns, ends), (len(views), len(observations.xyz)))
    sees.sum_duplicates()
    shared = (sees @ sees.T).tocsr()
    centres = np.stack([view.camera.centre.numpy() for view in views])
    seen = np.split(sees.indices, sees.indptr[1:-1])
    chosen = []
    for at in range(len(views)):
        part = slice(*shared.indptr[at : at + 2])
        others, counts = shared.indices[part], shared.data[part]
        order = np.lexsort((others, -counts))
        candidates = [int(other) for other in others[order] if other != at][:CANDIDATES]
        worth = {
            other: _worth(
                observations.xyz[np.intersect1d(seen[at], seen[other], assume_unique=True)], centres[[at, other]], angle
            )
            for other in candidates
        }
        chosen.append(_spread(worth, {other: centres[other] - centres[at] for other in worth}, count))
        emit(Progress("choosing what to compare", at + 1, len(views)))
    return chosen


def depth_range(view: View, observations: Observations, margin: float) -> tuple[float, float] | None:
    """Least and greatest inverse depth to try, 1/local units; None with too few sparse points.

    Args:
        view: To be estimated.
        observations: Where it shows sparse points.
        margin: Share of the range of the sparse points that is added at both ends.
    """
    _, inverse = observations.of(view, MAX_ERROR_PX)
    if len(inverse) <= MIN_POINTS:
        return None
    low, high = np.quantile(inverse, [OUTLIERS, 1 - OUTLIERS])
    more = margin * max(high - low, 0.1 * high)
    return float(max(low - more, low / 3)), float(high + more)


def _spread(worth: dict[int, float], baselines: dict[int, np.ndarray], count: int) -> list[int]:
    """Up to `count` of the views, best first; a view in the same direction as a chosen one weighs less."""
    left = {other: value for other, value in worth.items() if value > LEAST}
    chosen: list[int] = []
    while left and len(chosen) < count:
        best = max(left, key=lambda other: (left[other], -other))
        chosen.append(best)
        del left[best]
        for other in left:
            a, b = baselines[best], baselines[other]
            cosine = a @ b / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-12)
            left[other] *= 1 - SAME_SIDE * max(cosine, 0)
    return chosen


def _worth(xyz: np.ndarray, centres: np.ndarray, angle: float) -> float:
    rays = xyz - centres[:, None]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    between = np.degrees(np.arccos((rays[0] * rays[1]).sum(-1).clip(-1, 1)))
    spread = angle * np.where(between < angle, NARROW, WIDE)
    return float(np.exp(-((between - angle) ** 2) / (2 * spread**2)).sum())
