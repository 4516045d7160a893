"""How differently photographs were exposed, from how bright the same places are in them."""

from __future__ import annotations

import warnings

import numpy as np

SHADOW_OFFSET = 0.005
"""Added to the linear luminance before its logarithm: noise of the shadows is no exposure."""
WEIGHTS = (0.2126, 0.7152, 0.0722)
"""Of red, green and blue in the luminance of sRGB."""
MEDIAN_ROUNDS = 10
MIN_SHARED_PLACES = 10
"""Places that a photograph must share with others to be compared with them."""


def luminance(pixels: np.ndarray, places: np.ndarray) -> np.ndarray:
    """(S,) float32 log2 of the linear luminance at places, NaN outside.

    Args:
        pixels: (h, w, 3) uint8.
        places: (S, 2) shares of the width and height; NaN for those outside.
    """
    height, width = pixels.shape[:2]
    found = np.full(len(places), np.nan, np.float32)
    inside = np.isfinite(places).all(1)
    x, y = (np.minimum((places[inside, axis] * size).astype(int), size - 1) for axis, size in ((0, width), (1, height)))
    value = pixels[y, x].astype(np.float32) / 255
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    found[inside] = np.log2(linear @ np.array(WEIGHTS, np.float32) + SHADOW_OFFSET)
    return found


def exposures(brightness: np.ndarray) -> np.ndarray:
    """(V,) how many stops each photograph is brighter than the median one; NaN where too little is shared.

    Medians over places and over photographs in turn: what is hidden in a photograph, or has changed, does not count.

    Args:
        brightness: (V, S) log2 of the luminance of S places; NaN where a photograph does not show one.
    """
    shared = np.isfinite(brightness).sum(0) > 1
    brightness = brightness[:, shared]
    stops = np.zeros(len(brightness), np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # medians of nothing
        for _ in range(MEDIAN_ROUNDS):
            typical = np.nanmedian(brightness - stops[:, None], axis=0)
            found = np.nanmedian(brightness - typical, axis=1)
            stops = np.nan_to_num(found - np.nanmedian(found))
    known = np.isfinite(brightness).sum(1) >= MIN_SHARED_PLACES
    return np.where(known, stops, np.nan)
