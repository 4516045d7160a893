"""Whether depth maps have the unit of the cameras: compared with the sparse points, or with the extent of the scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from surfkit.scene.align import MAX_ERROR_PX, MIN_POINTS, sample
from surfkit.scene.observations import Observations
from surfkit.scene.scene import Scene, View

MAX_UNIT_RATIO = 1.25
"""A map in input units that is off by a larger factor from the sparse points that its photograph shows is in others."""
MAX_UNSEEN_RATIO = 2.0
"""The same where it is not known which points a photograph shows: some lie behind what it shows."""
MAX_DEPTH_EXTENTS = 200.0
"""Maps whose median depth is more scene extents, or less than one part in so many, are said to be in another unit."""
CELLS_PER_SIDE = 24
"""Of the points in a cell of a grid of so many a side over a photograph, the nearest one is taken to be in view."""
MAX_PROJECTED_POINTS = 100_000
"""Sparse points that are projected, at most."""
KNOWN_RATIOS = (1000.0, 100.0, 39.37, 12.0, 10.0, 3.2808, 1 / 0.9144)
"""Ratios of units: m to mm, cm, inch; foot to inch; cm to mm; m to foot; m to yard."""
KNOWN_RATIO_TOLERANCE = 0.03
"""A factor is told as a known ratio if it is off by a smaller share."""
UNIT_ADVICE = (
    "correct what the data set says of their unit (depth_unit_scale_factor or integer_depth_scale in transforms.json, "
    "scale in depth_params.json, --metres-per-unit), or make others with `surfkit prepare depth`"
)


@dataclass(frozen=True)
class Unit:
    """What tells the unit of a map.

    Attributes:
        ratio: Its depths by those of the sparse points, median; None where too few are in view.
        tracked: Whether it is known that the photograph shows these points.
        depth: Its median depth, local units.
    """

    ratio: float | None
    tracked: bool
    depth: float


def unit_of(inverse: np.ndarray, spots: np.ndarray, known: np.ndarray, tracked: bool) -> Unit:
    """What tells the unit of a map.

    Args:
        inverse: (h, w) inverse depth by the map, 1/local units; NaN or 0 where there is none.
        spots: (K, 2) where sparse points are in the map, as shares of width and height.
        known: (K,) inverse depth of these points, 1/local units.
        tracked: Whether it is known that the photograph shows them.
    """
    there = inverse[np.isfinite(inverse) & (inverse > 0)]
    depth = float(1 / np.median(there)) if len(there) else 0.0
    at = sample(np.where(inverse > 0, inverse, np.nan), spots)
    both = np.isfinite(at)
    ratio = float(np.median(known[both] / at[both])) if both.sum() > MIN_POINTS else None
    return Unit(ratio, tracked, depth)


def points_in(view: View, observations: Observations, scene: Scene, guess: bool) -> tuple[np.ndarray, np.ndarray, bool]:
    """Sparse points that a photograph shows: those that were found in it.

    Args:
        view: The photograph.
        observations: Which were found where.
        scene: With the sparse points.
        guess: Whether, where it is not known of any photograph, the nearest points before its camera stand in.

    Returns:
        (K, 2) shares of width and height; (K,) inverse depth, 1/local units; whether they were found in it.
    """
    at, inverse = observations.of(view, MAX_ERROR_PX)
    if not guess or not observations.is_empty or scene.cloud.drawn:
        return at, inverse, True
    xyz = scene.cloud.xyz[:: max(1, -(-len(scene.cloud.xyz) // MAX_PROJECTED_POINTS))].to(torch.float64).numpy()
    camera = view.camera
    pose = camera.world_to_camera.cpu().numpy()
    local = xyz @ pose[:3, :3].T + pose[:3, 3]
    local = local[local[:, 2] > 0]
    pixels = local[:, :2] / local[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    share = pixels / (camera.width, camera.height)
    inside = ((share >= 0) & (share < 1)).all(1)
    share, z = share[inside], local[inside, 2]
    order = np.argsort(z, kind="stable")
    cells = (share[order] * CELLS_PER_SIDE).astype(np.int64) @ (1, CELLS_PER_SIDE)
    nearest = order[np.unique(cells, return_index=True)[1]]
    return share[nearest], 1 / z[nearest], False


def in_other_units(units: Sequence[Unit | None]) -> dict[int, str]:
    """Why maps cannot be used whose depths are not those of the sparse points, by position.

    Where it is not known which points photographs show, all maps are judged together, by the median.

    Args:
        units: Of the maps; None where there is nothing to compare.
    """
    ratios = {at: unit.ratio for at, unit in enumerate(units) if unit is not None and unit.ratio is not None}
    loose = [at for at in ratios if not units[at].tracked]  # type: ignore[union-attr]
    off = {at: r for at, r in ratios.items() if at not in set(loose) and not 1 / MAX_UNIT_RATIO < r < MAX_UNIT_RATIO}
    if loose and not 1 / MAX_UNSEEN_RATIO < np.median([ratios[at] for at in loose]) < MAX_UNSEEN_RATIO:
        off |= {at: ratios[at] for at in loose}
    if not off:
        return {}
    middle = float(np.median(list(off.values())))
    alike = [at for at, ratio in off.items() if 1 / MAX_UNSEEN_RATIO < ratio / middle < MAX_UNSEEN_RATIO]
    same = (
        f"its depths are not those of the sparse points, but {factor(middle)} times as large, a wrong unit: "
        f"{UNIT_ADVICE}"
    )
    return {at: same if at in alike else "its depths are not those of the sparse points" for at in off}


def far_warning(units: Sequence[Unit | None], scene: Scene) -> str | None:
    """A warning about maps of a data set without sparse points, which nothing but the extent can be compared with."""
    depths = [unit.depth for unit in units if unit is not None and unit.depth > 0]
    if not scene.cloud.drawn or not depths:
        return None
    extents = float(np.median(depths))
    if 1 / MAX_DEPTH_EXTENTS < extents < MAX_DEPTH_EXTENTS:
        return None
    where = f"what is in view {extents:,.3g} times as far away as the cameras lie apart"
    return f"the depth maps put {where}: they seem to be in another unit than the cameras; {UNIT_ADVICE}"


def factor(ratio: float) -> str:
    """A factor in words, as a known one where it is near one."""
    up = max(ratio, 1 / ratio)
    up = next((known for known in KNOWN_RATIOS if abs(up / known - 1) < KNOWN_RATIO_TOLERANCE), up)
    return f"{up if ratio > 1 else 1 / up:,.4g}"
