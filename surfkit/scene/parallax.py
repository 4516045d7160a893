"""What the angle between two rays to a point is worth for finding its depth."""

from __future__ import annotations

import numpy as np

WIDTH_BELOW, WIDTH_ABOVE = 1 / 3, 1.5
"""Width of the worth below and above the preferred angle, as shares of that angle."""
MIN_ANGLE_SHARE = 1 / 12
"""Share of the preferred angle below which rays are worth nothing: photographs taken from one place match at any
depth, so they confirm whatever is tried."""


def degrees_between(points: np.ndarray, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(P,) degrees between the rays from two places, (3,) each, to (P, 3) points."""
    rays = (points - one, points - other)
    a, b = (ray / np.linalg.norm(ray, axis=1, keepdims=True).clip(1e-300) for ray in rays)
    return np.degrees(np.arccos((a * b).sum(1).clip(-1, 1)))


def least_apart(distance: float, angle: float) -> float:
    """How far apart two places are at least whose rays to a point at a distance from one are worth something."""
    return distance * float(np.sin(np.radians(MIN_ANGLE_SHARE * angle)))


def worth(between: np.ndarray, angle: float) -> np.ndarray:
    """Worth of angles, degrees, in [0, 1]: exp(-(a - angle)^2 / 2 s^2), and 0 below `MIN_ANGLE_SHARE`.

    s is small below the preferred angle, where there is little parallax, and large above, where photographs differ.
    """
    spread = angle * np.where(between < angle, WIDTH_BELOW, WIDTH_ABOVE)
    return np.where(between < MIN_ANGLE_SHARE * angle, 0, np.exp(-((between - angle) ** 2) / (2 * spread**2)))
