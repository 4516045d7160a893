"""Which cells of a surface model are ground, and what the others are: buildings, vegetation, or not known.

The ground filter is the simple morphological filter (SMRF) of Pingel, Clarke and McBride, "An improved simple
morphological filter for the terrain classification of airborne LIDAR data" (ISPRS Journal 77, 2013): openings of the
lowest surface with growing windows take away what stands on the ground. Windows are square, as in Zhang et al., "A
progressive morphological filter" (IEEE TGRS 41, 2003), as these cost the same for all sizes. All functions see the
whole map on coarse cells, so that there are no borders of tiles.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

OUTLIER_SLOPE = 5.0
"""Slope beside a cell that lies lower than all around it, above which it is an error and not ground (Pingel et al.)."""
OBJECT_SLOPES = 3.0
"""Multiple of the slope of the ground, over a whole window, from which something is an object however smooth it is."""
SWEEPS, OVER_RELAXATION = 32, 1.85
"""Of the interpolation, on each level: sweeps, and the factor by which each goes beyond the mean of the neighbours."""
GROUND, VEGETATION, BUILDING, UNCLASSIFIED = 2, 5, 6, 1
"""Classes of the LAS specification 1.4 (vegetation: high)."""
LEAST_OBJECT_METRES = 2.0
"""Height above ground from which something is taken for a building or high vegetation."""
PLANAR_METRES = 0.15
"""Root mean square distance from a plane, over 3 x 3 coarse cells, up to which a surface is that of a roof."""
LEAST_PLANE_SHARE = 0.25
"""Share of an object that is plane, from which the rest of it is of a building too."""
GREEN = 0.08
"""Excess green index, (2 G - R - B) / (R + G + B), from which a surface is green (Woebbecke et al., 1995)."""


def opened(lowest: np.ndarray, known: np.ndarray, radius: int) -> np.ndarray:
    """(H, W) morphological opening with a square window of 2 radius + 1 cells.

    Windows have their centres on known cells, and cells that are not known, or beyond the map, do not count. So an
    object that the border of the map cuts is removed like one that ends there.

    Args:
        lowest: (H, W) heights.
        known: (H, W) bool, where there is one.
        radius: Cells.
    """
    size = 2 * radius + 1
    eroded = ndimage.minimum_filter(np.where(known, lowest, np.inf), size, mode="constant", cval=np.inf)
    return ndimage.maximum_filter(np.where(known, eroded, -np.inf), size, mode="constant", cval=-np.inf)


def ground_cells(lowest: np.ndarray, cell: float, width: float, slope: float) -> np.ndarray:
    """(H, W) bool: cells that are ground.

    Args:
        lowest: (H, W) lowest height of the surface in each cell, NaN where there is none.
        cell: Side of a cell, in the unit of the heights.
        width: Of the widest object that is removed, same unit.
        slope: Height by distance up to which the ground may rise; what rises more above an opening is an object.
    """
    known = np.isfinite(lowest)
    turned = opened(-lowest, known, 1)
    ground = known & ~(-lowest - turned > OUTLIER_SLOPE * cell)
    surface, base = np.where(ground, lowest, 0.0), ground.copy()
    for radius in range(1, max(1, int(np.ceil(width / 2 / cell))) + 1):
        lower = np.where(base, opened(surface, base, radius), 0.0)
        # In all too: walls that a mesh has smoothed go bit by bit, each less than what ground may rise.
        steep = (surface - lower > slope * radius * cell) | (lowest - lower > OBJECT_SLOPES * slope * radius * cell)
        ground &= ~steep
        surface = lower
    return ground


def fill_smoothly(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """(H, W) float64 with the cells that are not known filled by a membrane that hangs from the known ones.

    Solves Laplace's equation from coarse to fine, by over-relaxation. So filled heights lie between those around, and
    a plane stays one. At the borders of the map the membrane is level. NaN everywhere if nothing is known.

    Args:
        values: (H, W) heights; only those of known cells count.
        known: (H, W) bool.
    """
    if known.all():
        return values.astype(np.float64)
    if not known.any():
        return np.full(values.shape, np.nan)
    high, wide = values.shape
    found = np.where(known, values, 0.0)
    if max(high, wide) > 2:
        padding = ((0, high % 2), (0, wide % 2))
        sums, counts = (_halved(np.pad(each, padding)) for each in (found, known.astype(np.float64)))
        coarse = fill_smoothly(sums / counts.clip(1), counts > 0)
        start = between_cells(coarse, 2, np.arange(high), np.arange(wide))
    else:
        start = np.full(values.shape, found.sum() / known.sum())
    found = np.where(known, values, start)
    colors = np.add.outer(np.arange(high), np.arange(wide)) % 2
    turns = [~known & (colors == color) for color in (0, 1)]
    for _ in range(SWEEPS):
        for turn in turns:
            around = np.pad(found, 1, mode="edge")
            mean = (around[:-2, 1:-1] + around[2:, 1:-1] + around[1:-1, :-2] + around[1:-1, 2:]) / 4
            found[turn] += OVER_RELAXATION * (mean - found)[turn]
    return found.clip(values[known].min(), values[known].max())


def _halved(values: np.ndarray) -> np.ndarray:
    """Sums over 2 x 2 cells."""
    return values[::2, ::2] + values[1::2, ::2] + values[::2, 1::2] + values[1::2, 1::2]


def between_cells(coarse: np.ndarray, factor: int, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """(n, m) bilinear interpolation of coarse cells at the centres of fine ones, for each the same whatever the others.

    Args:
        coarse: (H, W).
        factor: Fine cells along the side of a coarse one.
        rows: (n,) numbers of fine rows, from the upper border of the coarse cells.
        columns: (m,) the same of columns.
    """
    (top, down), (left, right) = (
        (((each + 0.5) / factor - 0.5).clip(0, size - 1), size)
        for each, size in zip((rows, columns), coarse.shape, strict=True)
    )
    first, across = top.astype(np.int64), left.astype(np.int64)
    second, beside = np.minimum(first + 1, down - 1), np.minimum(across + 1, right - 1)
    p, q = (top - first)[:, None], (left - across)[None]
    upper = (1 - q) * coarse[np.ix_(first, across)] + q * coarse[np.ix_(first, beside)]
    lower = (1 - q) * coarse[np.ix_(second, across)] + q * coarse[np.ix_(second, beside)]
    return (1 - p) * upper + p * lower


def slope_of(terrain: np.ndarray, cell: float) -> np.ndarray:
    """(H, W) slope of heights, height by distance; 0 along a side of one cell."""
    steps = [np.gradient(terrain, cell, axis=axis) for axis in (0, 1) if terrain.shape[axis] > 1]
    return np.sqrt(sum((step**2 for step in steps), np.zeros(terrain.shape)))


def roughness(top: np.ndarray, known: np.ndarray) -> np.ndarray:
    """(H, W) root mean square distance of the heights in 3 x 3 cells from a plane, the least of the windows that a cell
    lies in, as a cell at the edge of a roof lies in windows of the roof too; infinite where there is none.

    Args:
        top: (H, W) heights.
        known: (H, W) bool; windows with an unknown cell do not count.
    """
    base = np.where(known, top, 0.0)
    base = base - base.sum() / max(1, known.sum())
    down, across = ([[-1.0] * 3, [0.0] * 3, [1.0] * 3], [[-1.0, 0.0, 1.0]] * 3)
    mean, square = (ndimage.correlate(each, np.ones((3, 3)) / 9, mode="nearest") for each in (base, base**2))
    rises = [ndimage.correlate(base, np.array(kernel) / 6, mode="nearest") for kernel in (down, across)]
    variance = square - mean**2 - 2 / 3 * (rises[0] ** 2 + rises[1] ** 2)
    whole = ndimage.minimum_filter(known, 3, mode="constant", cval=False)
    return ndimage.minimum_filter(np.where(whole, np.sqrt(variance.clip(0)), np.inf), 3, mode="constant", cval=np.inf)


def classes(above: np.ndarray, rough: np.ndarray, green: np.ndarray | None, metre: float) -> np.ndarray:
    """(H, W) uint8 of what stands on the ground, a guess: BUILDING where a surface is plane and not green, VEGETATION
    where it is neither, UNCLASSIFIED where it cannot be told.

    Parts of an object that are neither are of the building (walls, chimneys) if at least a quarter of what is not green
    of that object is plane. Without colours trees beside a house would be taken for a part of it, so there only plane
    surfaces are BUILDING, and nothing is VEGETATION. Cells at the foot of an object have its class, for its walls.

    Args:
        above: (H, W) height above ground, NaN where there is no surface.
        rough: (H, W) roughness.
        green: (H, W) excess green index, NaN where no colour is known; None without colours.
        metre: Length of a metre in the unit of the heights.
    """
    with np.errstate(invalid="ignore"):
        stands = above >= LEAST_OBJECT_METRES * metre
        plane = stands & (rough <= PLANAR_METRES * metre)
        leaf = np.zeros(above.shape, bool) if green is None else stands & (green > GREEN)
    building = ndimage.binary_opening(plane & ~leaf, np.ones((3, 3)))  # a window; not the edge of a tree
    vegetation = leaf & ~plane
    if green is not None:
        objects, count = ndimage.label(stands, np.ones((3, 3)))
        grey = stands & ~leaf
        total, planes = (np.bincount(objects[each], minlength=count + 1) for each in (grey, building))
        building |= grey & (planes >= LEAST_PLANE_SHARE * total)[objects]
    found = np.full(above.shape, UNCLASSIFIED, np.uint8)
    found[building], found[vegetation] = BUILDING, VEGETATION
    return np.where(stands, found, ndimage.maximum_filter(found, 3))
