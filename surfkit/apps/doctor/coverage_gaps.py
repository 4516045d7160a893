"""Gaps within the ground that sparse points cover."""

from __future__ import annotations

import math

import numpy as np

from surfkit.apps.doctor.finding import Finding

MAX_EXAMINED_POINTS = 200_000
"""Points that are looked at."""
POINTS_PER_CELL = 6
"""Points in a cell of the ground, on average."""
MAX_CELLS_PER_SIDE = 64
"""Most cells along a side."""
MIN_HOLE_SHARE, MIN_HOLE_CELLS = 0.02, 4
"""Share of the covered ground, and cells, below which a hole does not count: points lie unevenly."""
MAX_GROUND_THICKNESS_RATIO = 0.5
"""Spread of the points across the ground over that along it, above which there is no ground to speak of."""
MAX_SHARE_BELOW_GROUND = 0.05
"""Share of the cameras that may lie beneath the ground."""
GROUND_POINT_SHARE = 0.9
"""Share of the points that decide where the ground is."""


def holes(xyz: np.ndarray, centres: np.ndarray) -> list[Finding]:
    """Where the ground below the cameras has no points, as one finding.

    The ground is the plane along which the points lie; where cameras are on both sides of it, there is none.

    Args:
        xyz: (P, 3) sparse points, input frame.
        centres: (V, 3) positions of the cameras.
    """
    if len(xyz) < 20 * POINTS_PER_CELL or len(centres) < 10:
        return []
    points = xyz[np.random.default_rng(0).permutation(len(xyz))[:MAX_EXAMINED_POINTS]]
    middle = np.median(points, 0)
    distance = np.linalg.norm(points - middle, axis=1)
    near = points[distance <= np.quantile(distance, GROUND_POINT_SHARE)] - middle
    _, spread, axes = np.linalg.svd(near[:20_000], full_matrices=False)
    above = float(((centres - middle) @ axes[2] > 0).mean())
    if (
        spread[2] > MAX_GROUND_THICKNESS_RATIO * spread[1]
        or MAX_SHARE_BELOW_GROUND < above < 1 - MAX_SHARE_BELOW_GROUND
    ):
        return []
    ground = (points - middle) @ axes[:2].T
    over = (centres - middle) @ axes[:2].T
    low, high = np.quantile(ground, [0.02, 0.98], axis=0)
    low, high = np.maximum(low, over.min(0)), np.minimum(high, over.max(0))
    if not (high > low).all():
        return []
    area, largest, where = _enclosed(ground, low, high)
    if largest < MIN_HOLE_SHARE:
        return []
    digits = max(1, 2 - math.floor(math.log10((high - low).max())))  # of a large place 0.1, whatever its coordinates
    spot = ", ".join(f"{value:.{digits}f}" for value in middle + where @ axes[:2])
    text = (
        f"coverage holes: {area:.0%} of the ground below the cameras has no sparse points, most of it about ({spot}): "
        "water or bare roofs, or photographs that are missing; nothing can be built where nothing was seen"
    )
    return [Finding("warning", "coverage-holes", text)]


def _enclosed(ground: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[float, float, np.ndarray]:
    """Shares of the covered ground that lie in all enclosed gaps and in the largest, and the middle of that."""
    from scipy import ndimage

    inside = ((ground >= low) & (ground <= high)).all(1)
    size = np.sqrt(np.prod(high - low) * POINTS_PER_CELL / inside.sum())
    shape = np.clip(np.ceil((high - low) / size), 3, MAX_CELLS_PER_SIDE).astype(int)
    counts, *edges = np.histogramdd(ground[inside], bins=list(shape), range=list(zip(low, high, strict=True)))
    covered = counts > 0
    filled = ndimage.binary_fill_holes(covered)
    gaps, _ = ndimage.label(filled & ~covered)
    sizes = np.bincount(gaps.reshape(-1))[1:]
    if sizes.max(initial=0) < MIN_HOLE_CELLS:
        return 0.0, 0.0, low
    middle = np.array(ndimage.center_of_mass(gaps == sizes.argmax() + 1))
    cells = [(edge[1] - edge[0]) for edge in edges[0]]
    where = low + (middle + 0.5) * cells
    counted = sizes[sizes >= MIN_HOLE_CELLS].sum()
    return float(counted / filled.sum()), float(sizes.max() / filled.sum()), where
