"""Relative inverse depth to the inverse depth of the sparse points, image by image (hierarchical 3DGS, appendix)."""

from __future__ import annotations

import numpy as np
from scipy.stats import spearmanr

from surfkit.core.check import BadInput

MAX_ERROR_PX = 1.5
"""Only sparse points with a smaller reprojection error count."""
MIN_POINTS = 10
"""More points than this are needed."""
MIN_RANGE = 0.01
"""The inverse depths of the points must differ by this share of their median: a flat view determines no scale."""
SCALE_BAND = (0.2, 5.0)
"""A scale that is outside these multiples of the median of all images is a failed alignment."""


def sample(values: np.ndarray, at: np.ndarray) -> np.ndarray:
    """(K,) bilinear samples of a map (h, w) at (K, 2) shares of its width and height; NaN where a neighbour is."""
    height, width = values.shape
    x = (at[:, 0] * width - 0.5).clip(0, width - 1)
    y = (at[:, 1] * height - 0.5).clip(0, height - 1)
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    u, v = x - left, y - top
    upper = values[top, left] * (1 - u) + values[top, right] * u
    lower = values[bottom, left] * (1 - u) + values[bottom, right] * u
    return upper * (1 - v) + lower * v


def align(values: np.ndarray, inverse: np.ndarray) -> tuple[float, float]:
    """Scale and offset that turn values of a map into inverse depths.

    scale = s_c / s_m and offset = t_c - scale * t_m, where t is the median and s the mean distance to it, of the
    inverse depths c and of the map m.

    Args:
        values: (K,) of the map, at the sparse points; NaN where it has none.
        inverse: (K,) inverse depth of the sparse points.

    Raises:
        BadInput: The points do not determine them; says why in a few words.
    """
    known = np.isfinite(values)
    m, c = values[known].astype(np.float64), inverse[known].astype(np.float64)
    if len(c) <= MIN_POINTS:
        raise BadInput(f"only {len(c)} sparse points; more than {MIN_POINTS} are needed")
    t_c, t_m = np.median(c), np.median(m)
    if np.ptp(c) <= MIN_RANGE * t_c:
        raise BadInput("all sparse points at one depth")
    s_c, s_m = np.abs(c - t_c).mean(), np.abs(m - t_m).mean()
    if s_m <= 1e-6 * np.abs(m).max():
        raise BadInput("constant")
    scale = s_c / s_m
    return float(scale), float(t_c - scale * t_m)


def rank_correlation(values: np.ndarray, inverse: np.ndarray) -> float:
    """Spearman's, -1 to 1, of values (K,) of a map, NaN where it has none, with the inverse depths (K,) of points."""
    known = np.isfinite(values)
    return float(spearmanr(values[known], inverse[known]).statistic)
