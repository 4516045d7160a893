"""Values of vertices as colours: warm where little is known, cool where much is."""

from __future__ import annotations

import numpy as np

from surfkit.mesh.base import LENGTHS

WARM_TO_COOL = np.array([[190, 30, 45], [240, 130, 60], [250, 215, 120], [130, 190, 215], [45, 85, 165]], float)
"""sRGB at equal steps, from dark red by pale yellow to dark blue: also those who do not tell red from green see it."""
UNKNOWN_GREY = 128
"""Grey of vertices whose value is not known."""
VIEW_COUNT_RANGE = (1.0, 10.0)
"""Photographs at the ends of the colours, the same for all meshes: they can be compared."""
PERCENTILES = (2, 98)
"""Of lengths, at the ends of the colours."""


def ends_of(name: str, values: np.ndarray) -> tuple[float, float]:
    """The values at the ends of the colours, lower one first."""
    if name not in LENGTHS:
        return VIEW_COUNT_RANGE
    known = values[np.isfinite(values)]
    low, high = np.percentile(known, PERCENTILES) if len(known) else (0.0, 0.0)
    return float(low), float(high)


def by_value(name: str, values: np.ndarray, ends: tuple[float, float]) -> np.ndarray:
    """(V, 3) uint8 of (V,) values: few photographs and large errors are red, many and small ones blue.

    Args:
        name: See `VALUES`.
        values: Of the vertices.
        ends: From `ends_of`; photographs are in equal steps of their logarithm.
    """
    known = np.isfinite(values)
    found, (low, high) = np.where(known, values, ends[0]), ends
    if name in LENGTHS:
        share = (high - found) / max(high - low, 1e-30)
    else:
        share = np.log(np.maximum(found, low) / low) / np.log(high / low)
    steps = np.linspace(0, 1, len(WARM_TO_COOL))
    colors = np.stack([np.interp(share, steps, channel) for channel in WARM_TO_COOL.T], axis=1)
    return np.where(known[:, None], np.rint(colors), UNKNOWN_GREY).astype(np.uint8)


def words_of(name: str, ends: tuple[float, float], unit: str) -> str:
    """What the colours mean, in one line; `unit` is that of the numbers in `ends`, where they are lengths."""
    low, high = ends
    if name in LENGTHS:
        return f"error: blue {low:.3g} {unit} or less, red {high:.3g} {unit} or more, grey not known"
    return f"views: red {low:g} or none, blue {high:g} or more photographs that confirm the surface"
