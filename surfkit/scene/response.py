"""The numbers of photographs and cameras in `camera-response`, and what they mean; for arrays of numpy and of torch.

A photograph has 3, the stops of red, green and blue; a camera has 8. Places on the sensor are counted from the
principal point, in halves of the picture's diagonal, so that they do not depend on its size.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from surfkit.scene.camera import Camera

FALLOFF, CENTRE, CURVE = slice(0, 3), slice(3, 5), slice(5, 8)
"""Numbers of a camera: stops of vignetting at r^2, r^4 and r^6; where r is 0; three terms of the response curve."""
STOPS, OF_CAMERA = 3, 8
"""How many numbers a photograph and a camera have."""
MAX_SLOPE_CHANGE = 0.9
"""A response curve is nowhere steeper than 1.9 times the standard one, and nowhere flatter than 0.1 times."""
MEAN_STEPS = 64
"""Places along each side of a picture, or around it, of which a mean is taken."""
TABLE_VALUES = 4096
"""Of the table by which a response curve is turned round: sixteen for each step of 8 bits."""
KNEE = 0.04045
"""sRGB is straight up to here, and a power of the light above (IEC 61966-2-1)."""


def sensor_scale(camera: Camera) -> float:
    """What turns pixels from the principal point into places on the sensor."""
    return 2 / math.hypot(camera.width, camera.height)


def falloff(values: Any, squared: Any) -> Any:
    """Stops that vignetting takes at r^2 = `squared`, by the 8 numbers of a camera, (8, ...)."""
    a, b, c = values[FALLOFF]
    return squared * (a + squared * (b + squared * c))


def mean_falloff(values: np.ndarray, camera: Camera) -> float:
    """Stops that vignetting takes from a picture of a camera on average, by its (8,) numbers."""
    axes = zip((camera.width, camera.height), (camera.cx, camera.cy), values[CENTRE], strict=True)
    x, y = (
        ((np.arange(MEAN_STEPS) + 0.5) / MEAN_STEPS * side - middle) * sensor_scale(camera) - centre
        for side, middle, centre in axes
    )
    return float(falloff(values, x**2 + y[:, None] ** 2).mean())


def corner_light(values: np.ndarray) -> float:
    """Light half a diagonal away from the middle of a picture, the geometric mean all around, as a share of that in the
    middle, by the (8,) numbers of a camera."""
    turns = np.arange(MEAN_STEPS) / MEAN_STEPS * 2 * math.pi
    x, y = np.cos(turns) - values[CENTRE][0], np.sin(turns) - values[CENTRE][1]
    middle = falloff(values, np.square(values[CENTRE]).sum())
    return float(2 ** (middle - falloff(values, x**2 + y**2).mean()))


def curved(encoded: Any, curve: Any) -> Any:
    """What a response curve makes of values in [0, 1]; `curve` has its three numbers, (3, ...)."""
    return encoded + sum(number * term for number, term in zip(curve, curve_terms(encoded), strict=True))


def uncurved(values: np.ndarray, curve: np.ndarray) -> np.ndarray:
    """(...) values in [0, 1] that a response curve maps to these; `curve` has its three numbers, (3,)."""
    fine = np.linspace(0, 1, TABLE_VALUES)
    return np.interp(values, curved(fine, curve), fine)


def curve_slope(encoded: Any, curve: Any) -> Any:
    """The derivative of `curved` by the values."""
    u = 1 - 2 * encoded
    return 1 + curve[0] * u + curve[1] * (3 * u * u - 1) / 2 + curve[2] * u * (5 * u * u - 3) / 2


def curve_terms(encoded: Any) -> tuple[Any, Any, Any]:
    """What each of the three numbers adds to values in [0, 1]: integrals of the Legendre polynomials P1, P2 and P3 of
    1 - 2 x value. They are 0 at both ends. As no |P| is above 1, numbers of a sum up to 1 keep the curve monotone."""
    u = 1 - 2 * encoded
    bow = (1 - u * u) / 4
    return bow, bow * u, bow * (5 * u * u - 1) / 4
