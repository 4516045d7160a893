"""Choice of source photographs and of the depth range, from the sparse points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import reverse_cuthill_mckee

from surfkit.core.events import Progress, emit
from surfkit.scene.align import MAX_ERROR_PX, MIN_POINTS
from surfkit.scene.observations import Observations
from surfkit.scene.parallax import degrees_between, least_apart, worth
from surfkit.scene.scene import View

SAME_SIDE_LOSS = 0.8
"""Share of its weight that a view loses when another stands in the same direction: both see the same occlusions."""
MIN_PAIR_WEIGHT = 0.1
"""A pair with a weight of fewer than this many well placed points is not compared."""
MAX_CANDIDATE_VIEWS = 40
"""Number of views, those with most shared points and not taken from the same place, that are looked at."""
OUTLIER_POINT_SHARE = 0.01
"""Share of the sparse points that may lie closer than the depths tried, and farther away."""


def neighbours(views: Sequence[View], observations: Observations, count: int, angle: float) -> list[list[int]]:
    """For each view, positions of up to `count` views to compare it with, best first.

    A pair is worth the sum, over the points that both see, of the worth of the angle between the two rays.

    Args:
        views: V views.
        observations: Where they show sparse points.
        count: Of neighbours.
        angle: Between rays, degrees.
    """
    nothing = np.empty(0, np.int64)
    rows = [observations.seen[view.name].points if view.name in observations.seen else nothing for view in views]
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
        apart = np.linalg.norm(centres[others] - centres[at], axis=1)
        far = (others != at) & (apart >= least_apart(_nearest(observations.xyz[seen[at]], centres[at]), angle))
        order = np.lexsort((others, -counts))
        worths: dict[int, float] = {}
        for other in (int(other) for other in others[order[far[order]]]):
            both = np.intersect1d(seen[at], seen[other], assume_unique=True)
            if value := _worth(observations.xyz[both], centres[at], centres[other], angle):
                worths[other] = value
            if len(worths) == MAX_CANDIDATE_VIEWS:
                break
        chosen.append(_spread(worths, {other: centres[other] - centres[at] for other in worths}, count))
        emit(Progress("choosing what to compare", at + 1, len(views)))
    return chosen


def in_turn(pairs: Sequence[Sequence[int]], wanted: Sequence[int]) -> list[int]:
    """The wanted views, those that are compared with one another close together (Cuthill and McKee 1969).

    Maps of a view are kept until the last view is done that is compared with it, so the disk that they take is that of
    a line through the scene and not of a scene whose photographs are named in any order.
    """
    ends = np.cumsum([0, *map(len, pairs)])
    others = np.concatenate([np.asarray(each, np.int32) for each in pairs]) if ends[-1] else np.zeros(0, np.int32)
    graph = csr_matrix((np.ones(len(others), np.int8), others, ends), (len(pairs), len(pairs)))
    order, chosen = reverse_cuthill_mckee(graph + graph.T, symmetric_mode=True), set(wanted)
    return [at for at in order.tolist() if at in chosen]


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
    low, high = np.quantile(inverse, [OUTLIER_POINT_SHARE, 1 - OUTLIER_POINT_SHARE])
    more = margin * max(high - low, 0.1 * high)
    return float(max(low - more, low / 3)), float(high + more)


def _spread(worths: dict[int, float], baselines: dict[int, np.ndarray], count: int) -> list[int]:
    """Up to `count` of the views, best first; a view in the same direction as a chosen one weighs less."""
    left = {other: value for other, value in worths.items() if value > MIN_PAIR_WEIGHT}
    chosen: list[int] = []
    while left and len(chosen) < count:
        best = max(left, key=lambda other: (left[other], -other))
        chosen.append(best)
        del left[best]
        for other in left:
            a, b = baselines[best], baselines[other]
            cosine = a @ b / max(np.linalg.norm(a) * np.linalg.norm(b), 1e-12)
            left[other] *= 1 - SAME_SIDE_LOSS * max(cosine, 0)
    return chosen


def _nearest(xyz: np.ndarray, place: np.ndarray) -> float:
    """Distance from a place that all points but a few outliers exceed; 0 where there is no point."""
    distances = np.linalg.norm(xyz[np.isfinite(xyz).all(1)] - place, axis=1)
    return float(np.quantile(distances, OUTLIER_POINT_SHARE)) if len(distances) else 0.0


def _worth(xyz: np.ndarray, one: np.ndarray, other: np.ndarray, angle: float) -> float:
    there = xyz[np.isfinite(xyz).all(1)]  # some programs write points that lie nowhere
    return float(worth(degrees_between(there, one, other), angle).sum())
