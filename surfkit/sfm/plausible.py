"""What a survey can be: cameras above the ground that look down or level, and places that are not mirrored."""

from __future__ import annotations

from typing import Any

import numpy as np

from surfkit.readers.georeference import Similarity
from surfkit.sfm.level import points_of, poses_of
from surfkit.sfm.similarity import umeyama

UPRIGHT = 0.5
"""Cosine between up on the map and up by how cameras are held; between this and its negative neither is sure."""
LOOKS_UP = 0.3
"""Sine of the mean direction of view above the horizon, beyond which cameras look up."""
MIRRORED = 3.0
"""A mirrored fit that is so many times better is no chance."""


def upside_down(model: Any, similarity: Similarity, up: np.ndarray, metres: float) -> str | None:
    """Why a similarity puts a reconstruction upside down, in half a sentence; None where it does not.

    Args:
        model: pycolmap.Reconstruction, before the similarity.
        similarity: To the map.
        up: (3,) unit vector of the model, by how cameras are held.
        metres: Per unit of the map.
    """
    poses = poses_of(model)
    view = float((similarity.turn @ poses[:, 2, :3].mean(0))[2])
    centres = similarity.points(-np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3]))
    points = similarity.points(points_of(model))
    above = float(np.median(centres[:, 2]) - np.median(points[:, 2])) * metres if len(points) else 0.0
    upright = float((similarity.turn @ up)[2])
    if upright > -UPRIGHT and not (upright < UPRIGHT and view > LOOKS_UP and above < 0):
        return None
    degrees = np.degrees(np.arcsin(np.clip(view, -1, 1)))
    where = f"{abs(above):.0f} m {'below' if above < 0 else 'above'} the ground"
    direction = f"{abs(degrees):.0f} degrees {'above' if degrees > 0 else 'below'} the horizon"
    return f"the photographs would be upside down, {where}, with a mean direction of view {direction}"


def mirrored(xyz: np.ndarray, onto: np.ndarray, least: float) -> tuple[float, float] | None:
    """Root mean squares of the residuals of a similarity, and of a mirrored one; None where that is not far better.

    Args:
        xyz: (P, 3) positions.
        onto: (P, 3) where they belong.
        least: Residuals below it are no reason, in the unit of `onto`.
    """
    even = np.ones(len(xyz))
    plain, other = (
        float(np.sqrt(((onto - umeyama(given, onto, even).points(given)) ** 2).sum(1).mean()))
        for given in (xyz, xyz * (1, 1, -1))
    )
    return (plain, other) if plain > max(MIRRORED * other, least) else None
