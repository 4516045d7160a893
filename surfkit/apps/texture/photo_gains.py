"""How brightly each photograph was exposed, and what its colours become so that all fit together.

Gains are the most likely ones, as in Brown and Lowe, Automatic Panoramic Image Stitching using Invariant Features,
IJCV 2007, section 6: ratios of the colours that two photographs share are known to `PAIR_SIGMA`, and gains are near 1
within `GAIN_SIGMA`. Errors of the ratios that have the same sign from pair to pair, as a slope of brightness within all
photographs gives, would otherwise add up along a strip.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import spsolve

MIN_SHARED_TRIANGLES = 30
"""Triangles that two photographs must both show for their brightness to be compared."""
MIN_USABLE_COLOR, MAX_USABLE_COLOR = 8, 247
"""Colours beyond these tell nothing of the brightness of a photograph."""
MAX_SAMPLED_TRIANGLES = 2_000_000
"""Triangles that gains are taken from, of a larger mesh: each gives up to 28 pairs of colours."""
PAIR_SIGMA, GAIN_SIGMA = 0.05, 0.2
"""Standard deviations: of the logarithm of the ratio of two photographs, and of the logarithm of a gain. Large gains
are held at 1 less, as Cauchy's distribution has it: some photographs were exposed quite otherwise."""
REWEIGHTING_ROUNDS = 8
"""Of weighing gains anew."""
MAX_GAIN = 2.0
"""No gain is larger, or smaller than the inverse."""
KNEE = 0.8
"""Colours up to here are multiplied by the gain; brighter ones come to white where they are white in the photograph."""
DARK_COLOR = 0.05
"""Darker colours are changed less at seams."""
NO_PHOTO = -1


def exposure_gains(shown: np.ndarray, color: np.ndarray, views: int) -> np.ndarray:
    """(V, 3) float64 what the colours of each photograph must be multiplied by to fit to the others; the median is 1.

    For each pair of photographs, the median ratio of the colours of the triangles that both show is used. Of a large
    mesh, evenly spread triangles are enough.

    Args:
        shown: (F, K) photographs that show each triangle; NONE where there are fewer.
        color: (F, K, 3) uint8 its mean colour in them.
        views: How many photographs there are.
    """
    step = -(-len(shown) // MAX_SAMPLED_TRIANGLES)
    shown, color = shown[::step], color[::step]
    logs, known = np.zeros((views, 3)), np.zeros(views, bool)
    for channel in range(3):
        one, other, ratio = [], [], []
        for a in range(shown.shape[1]):
            for b in range(a + 1, shown.shape[1]):
                values = color[:, [a, b], channel]
                usable = (shown[:, [a, b]] != NO_PHOTO).all(1) & (
                    (values > MIN_USABLE_COLOR) & (values < MAX_USABLE_COLOR)
                ).all(1)
                first, second = shown[usable][:, [a, b]].T
                value = np.log(values[usable, 0].astype(np.float32)) - np.log(values[usable, 1].astype(np.float32))
                swapped = first > second
                one.append(np.where(swapped, second, first))
                other.append(np.where(swapped, first, second))
                ratio.append(np.where(swapped, -value, value))
        fitted = _fitted(np.concatenate(one), np.concatenate(other), np.concatenate(ratio), views)
        logs[:, channel], compared = fitted
        known |= compared
    if known.any():
        logs[known] -= np.median(logs[known], axis=0)
    return np.exp(logs.clip(-np.log(MAX_GAIN), np.log(MAX_GAIN)))


def exposed(color: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """(..., 3) colours in [0, 1] of a photograph, as its gain makes them: in [0, 1] too.

    They are multiplied by the gain up to `KNEE`, before or after. From there a monotone curve of one rational quadratic
    (Gregory and Delbourgo, Piecewise Rational Quadratic Interpolation to Monotonic Data, IMA Journal of Numerical
    Analysis, 1982) goes to white, where it has the slope 1: as many colours are nearly white as in the photograph.

    Args:
        color: (..., 3).
        gain: (..., 3), see `exposure_gains`.
    """
    start = KNEE / np.maximum(gain, 1)
    mean = (1 - gain * start) / (1 - start)
    t = ((color - start) / (1 - start)).clip(0, 1)
    beyond = (1 - gain * start) * (mean * t**2 + gain * t * (1 - t)) / (mean + (gain + 1 - 2 * mean) * t * (1 - t))
    return np.where(color <= start, gain * color, gain * start + beyond)


def levelled(color: np.ndarray, added: np.ndarray) -> np.ndarray:
    """(..., 3) uint8 of colours in [0, 1] with what is added to them, less the nearer they are to black or white: there
    it would clip, and no seam shows."""
    room = np.minimum(color / DARK_COLOR, (1 - color) / (1 - KNEE)).clip(0, 1)
    return np.rint(255 * (color + room * added)).clip(0, 255).astype(np.uint8)


def _fitted(one: np.ndarray, other: np.ndarray, ratio: np.ndarray, views: int) -> tuple[np.ndarray, np.ndarray]:
    """(V,) logarithms of the gains, of logarithms of ratios between two photographs; (V,) which are compared to any."""
    pair = one.astype(np.int64) * views + other
    order = np.lexsort((ratio, pair))
    pair, ratio = pair[order], ratio[order]
    first = np.flatnonzero(np.diff(pair, prepend=-1))
    count = np.diff(np.append(first, len(pair)))
    middle = (ratio[first + (count - 1) // 2] + ratio[first + count // 2]) / 2 if len(first) else np.empty(0)
    known = count >= MIN_SHARED_TRIANGLES
    a, b = np.divmod(pair[first[known]], views)
    middle, weight = middle[known], np.full(known.sum(), PAIR_SIGMA**-2)
    # gain of a + ratio = gain of b
    sums = np.bincount(a, weight, views) + np.bincount(b, weight, views)
    rows = np.concatenate([a, b, np.arange(views)])
    columns = np.concatenate([b, a, np.arange(views)])
    side = np.bincount(b, weight * middle, views) - np.bincount(a, weight * middle, views)
    found = np.zeros(views)
    for _ in range(REWEIGHTING_ROUNDS):
        held = sums + 1 / (GAIN_SIGMA**2 + found**2)
        matrix = coo_matrix((np.concatenate([-weight, -weight, held]), (rows, columns)), (views, views))
        found = np.atleast_1d(spsolve(matrix.tocsc(), side))
    return found, sums > 0
