"""Alignment of a reconstruction to the truth: three rounds of point-to-point ICP at shrinking distances.

Where one of the two reaches beyond the other, the nearest point of what is beyond lies on the border, and pulls the fit
towards it. Pairs that are nearest in both directions have no such points (mutual matches: the overlap decides).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from surfkit.evaluate.geometry.scores import WORKERS, tree
from surfkit.evaluate.geometry.transform import apply, fitted, scale_of

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

ICP_ROUNDS = ((1.0, 80.0), (0.5, 20.0), (0.5, 2.0))
"""Voxel and reach of each round, multiples of tau (the Tanks and Temples toolbox, whose last round thins by count)."""
ITERATIONS = 20
MAX_SCALE_FACTOR = 2.0
"""Factor of size at which a round gives up."""
MIN_CHANGE = 1e-6
"""Of the matched share and of the residual, as a share of it, at which a round is over."""
MUTUAL_VOXELS = 2.0
"""Voxels between a point and the one that its partner finds, up to which the two are a mutual match."""
MAX_MATCHED_POINTS = 100_000
"""Points of the reconstruction that are matched: many more than seven numbers need."""


@dataclass(frozen=True)
class IcpResult:
    """What ICP found.

    Attributes:
        matrix: (4, 4) from the frame of the reconstruction to that of the truth.
        matched: Share of the points with a partner within the reach of the last round.
        residual: Root mean square distance of those, in units of the truth; None without any.
    """

    matrix: np.ndarray
    matched: float
    residual: float | None

    @property
    def scale(self) -> float:
        """By how much lengths change."""
        return scale_of(self.matrix)


Clouds = Callable[[float, np.ndarray], tuple[np.ndarray, "cKDTree", np.ndarray]]
"""For a voxel and the transform so far: (n, 3) points of the reconstruction in its own frame, and the truth as a search
tree and as the (m, 3) points of it, each thinned and inside the crop volume."""


def align(clouds: Clouds, start: np.ndarray, tau: float, with_scale: bool, mutual: bool = False) -> IcpResult:
    """The reconstruction brought to the truth, from a start that is not far off.

    Args:
        clouds: What to compare.
        start: (4, 4), such as the identity.
        tau: Threshold that sets the distances of the rounds.
        with_scale: Whether the size may change.
        mutual: Whether only mutual matches count.
    """
    found = IcpResult(start, 0.0, None)
    for voxel, reach in ICP_ROUNDS:
        source, there, target = clouds(voxel * tau, found.matrix)
        if len(source) > MAX_MATCHED_POINTS:
            source = source[np.linspace(0, len(source) - 1, MAX_MATCHED_POINTS).astype(np.int64)]
        begin, slack = IcpResult(found.matrix, 0.0, None), MUTUAL_VOXELS * voxel * tau if mutual else None
        found = icp(source, there, target, begin, reach * tau, with_scale, slack)
    return found


def icp(
    source: np.ndarray,
    there: cKDTree,
    target: np.ndarray,
    start: IcpResult,
    reach: float,
    with_scale: bool,
    slack: float | None = None,
) -> IcpResult:
    """One round: match each point with the nearest within reach, fit, and again, until nothing changes.

    Args:
        source: (n, 3) points of the reconstruction, in its own frame.
        there: Search tree of the truth.
        target: (m, 3) points of that tree.
        start: Where to begin.
        reach: Largest distance of a match.
        with_scale: Whether the size may change.
        slack: Largest distance, in the frame of the truth, of a point from the one that its partner finds; None if
            the partner is not asked.
    """
    found, here = start, None if slack is None else tree(source)
    for _ in range(ITERATIONS):
        away, partner = there.query(apply(found.matrix, source), distance_upper_bound=reach, workers=WORKERS)
        near = np.isfinite(away)
        if here is not None and slack is not None:
            near[near] = _answered(source[near], here, source, target[partner[near]], found.matrix, slack)
        residual = float(np.sqrt((away[near] ** 2).mean())) if near.any() else None
        now = IcpResult(found.matrix, float(near.mean()), residual)
        if found.residual is not None and residual is not None and abs(now.matched - found.matched) < MIN_CHANGE:
            if abs(residual - found.residual) < MIN_CHANGE * max(residual, found.residual):
                return now
        if near.sum() < 3 or residual == 0:
            return now
        matrix = fitted(source[near], target[partner[near]], with_scale)
        if not 1 / MAX_SCALE_FACTOR < np.cbrt(abs(np.linalg.det(matrix[:3, :3]))) / start.scale < MAX_SCALE_FACTOR:
            return now  # the two do not fit, and a smaller one is always nearer
        found = IcpResult(matrix, now.matched, now.residual)
    away, _ = there.query(apply(found.matrix, source), distance_upper_bound=reach, workers=WORKERS)
    near = np.isfinite(away)
    return IcpResult(found.matrix, float(near.mean()), float(np.sqrt((away[near] ** 2).mean())) if near.any() else None)


def _answered(
    points: np.ndarray, here: cKDTree, source: np.ndarray, partners: np.ndarray, matrix: np.ndarray, slack: float
) -> np.ndarray:
    """(n,) bool: whether the partners of (n, 3) points find these, or points of the source near them."""
    _, back = here.query(apply(np.linalg.inv(matrix), partners), workers=WORKERS)
    return np.linalg.norm(source[back] - points, axis=1) * scale_of(matrix) <= slack
