"""Values of splats in a few bits, as several formats hold them."""

from __future__ import annotations

import numpy as np

from surfkit.scene.morton import morton_order

SH_C0 = 0.28209479177387814
"""The spherical harmonic of degree 0."""
MIN_OPACITY = 0.25 / 255
"""Least opacity that a byte of 0 stands for: it becomes the same byte again, and has a logit."""
TAIL_SHARE = 0.1
"""Share of the splats at either end of an axis that say nothing about the extent of the others."""
OUTLYING_EXTENTS = 4.0
"""Extents from the middle beyond which splats are far from the others."""
OTHER_COMPONENTS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
"""Components beside the largest."""


def sigmoid(logits: np.ndarray) -> np.ndarray:
    """Opacities in [0, 1] of logits, float32."""
    return 1 / (1 + np.exp(-logits.clip(-80, 80)))


def logits(opacities: np.ndarray) -> np.ndarray:
    """Float32 logits of opacities in [0, 1] that were bytes."""
    inside = opacities.astype(np.float64).clip(MIN_OPACITY, 1 - MIN_OPACITY)
    return np.log(inside / (1 - inside)).astype(np.float32)


def to_bytes(values: np.ndarray) -> np.ndarray:
    """The nearest uint8 of values on the scale of 0 to 255; what lies outside is clipped."""
    return (values + 0.5).clip(0, 255).astype(np.uint8)


def smallest_three(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations without their largest component, which the others imply.

    Args:
        quats: (N, 4) of length 1, components in any order.

    Returns:
        (N,) which component is the largest, and the (N, 3) others in their order, times the square root of 2 so that
        they span [-1, 1]; of the two quaternions of a rotation, that whose largest component is positive.
    """
    largest = np.abs(quats).argmax(1)
    sign = np.where(np.take_along_axis(quats, largest[:, None], 1) < 0, -1.0, 1.0)
    return largest, np.take_along_axis(quats, OTHER_COMPONENTS[largest], 1) * (sign * np.sqrt(2))


def from_smallest_three(largest: np.ndarray, three: np.ndarray) -> np.ndarray:
    """(N, 4) float32 quaternions that `smallest_three` gives for these."""
    quats = np.empty((len(three), 4), np.float32)
    np.put_along_axis(quats, OTHER_COMPONENTS[largest], (three / np.sqrt(2)).astype(np.float32), 1)
    rest = np.sqrt((1 - (three.astype(np.float64) ** 2).sum(1) / 2).clip(0))
    np.put_along_axis(quats, largest[:, None], rest[:, None].astype(np.float32), 1)
    return quats


def outlying_order(means: np.ndarray, shown: np.ndarray, group: int) -> np.ndarray:
    """(N,) indices that sort (N, 3) positions as `morton_order`, with those far from the others together at the end.

    Splats of a group share the range of their positions. Those that lie outside of OUTLYING times the extent of most
    come last, octave by octave of their distance. What fills up the first group with such ones, as groups have a
    fixed size, are those splats of which least is seen.

    Args:
        means: (N, 3).
        shown: (N,) how much is seen of each splat.
        group: Splats of a group.
    """
    if len(means) <= group:
        return morton_order(means)
    low, high = np.quantile(means, (TAIL_SHARE, 1 - TAIL_SHARE), axis=0)
    away = np.abs(means - (low + high) / 2).max(1)
    extent = max(float((high - low).max()), away.max() * 2.0**-40, np.finfo(float).tiny)
    octave = np.ceil(np.log2(np.maximum(away / (OUTLYING_EXTENTS * extent), 1))).astype(int)
    core = np.flatnonzero(octave == 0)
    if len(core) < len(means) and (left := len(core) % group):
        filling = core[np.argsort(shown[core], kind="stable")[:left]]
        octave[core] = -1
        octave[filling] = 0
    parts = [np.flatnonzero(octave == each) for each in np.unique(octave)]
    return np.concatenate([part[morton_order(means[part])] for part in parts])
