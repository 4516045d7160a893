"""What a survey can be: cameras above the ground that look down or level, and places that are not mirrored."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from surfkit.apps.sfm.gravity_alignment import points_of, poses_of
from surfkit.apps.sfm.similarity import umeyama
from surfkit.io.datasets.topocentric import Similarity

MAX_POSITION_ERROR_M, MAX_ALTITUDE_ERROR_M = 1000.0, 300.0
"""Receivers in cameras are not so wrong, across and in altitude, whatever they count it from."""
MIN_LAND_M = -100.0
"""Little land is lower."""
MIN_UPRIGHT_COSINE = 0.5
"""Cosine between up on the map and up by how cameras are held; between this and its negative neither is sure."""
MIN_UPWARD_SINE = 0.3
"""Sine of the mean direction of view above the horizon, beyond which cameras look up."""
MIN_FIT_RATIO = 3.0
"""A fit that is so many times better than a mirrored one is no chance, nor the other way round."""


@dataclass(frozen=True)
class Handedness:
    """Whether places are told from their mirror image: how well a similarity fits, and how well a mirrored one.

    Attributes:
        plain: Root mean square of the residuals of a similarity.
        mirrored: That of a mirrored one.
        least: What is below it says nothing.
    """

    plain: float
    mirrored: float
    least: float

    @classmethod
    def of(cls, xyz: np.ndarray, onto: np.ndarray, least: float) -> Handedness:
        """That of (P, 3) positions and the (P, 3) places where they belong; `least` is in the unit of these."""
        even = np.ones(len(xyz))
        plain, mirrored = (
            float(np.sqrt(((onto - umeyama(given, onto, even).points(given)) ** 2).sum(1).mean()))
            for given in (xyz, xyz * (1, 1, -1))
        )
        return cls(plain, mirrored, least)

    @property
    def right(self) -> bool:
        """Whether the mirrored one is far worse."""
        return self.mirrored > max(MIN_FIT_RATIO * self.plain, self.least)

    @property
    def wrong(self) -> bool:
        """Whether the mirrored one is far better."""
        return self.plain > max(MIN_FIT_RATIO * self.mirrored, self.least)


def upside_down(model: Any, similarity: Similarity, up: np.ndarray, metres: float, handed: bool) -> str | None:
    """Why a similarity puts a reconstruction upside down, in half a sentence; None where it does not.

    Args:
        model: pycolmap.Reconstruction, before the similarity.
        similarity: To the map.
        up: (3,) unit vector of the model, by how cameras are held.
        metres: Per unit of the map.
        handed: Whether the places are told from their mirror image: cameras that look level are then held upside down.
    """
    poses = poses_of(model)
    view = float((similarity.turn @ poses[:, 2, :3].mean(0))[2])
    centres = similarity.points(-np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3]))
    points = similarity.points(points_of(model))
    above = float(np.median(centres[:, 2]) - np.median(points[:, 2])) * metres
    upright = float((similarity.turn @ up)[2])
    turned = upright < -MIN_UPRIGHT_COSINE and not (handed and view < MIN_UPWARD_SINE)
    if not turned and not (upright < MIN_UPRIGHT_COSINE and view > MIN_UPWARD_SINE and above < 0):
        return None
    degrees = np.degrees(np.arcsin(np.clip(view, -1, 1)))
    where = f"{abs(above):.0f} m {'below' if above < 0 else 'above'} the ground"
    direction = f"{abs(degrees):.0f} degrees {'above' if degrees > 0 else 'below'} the horizon"
    return f"the photographs would be upside down, {where}, with a mean direction of view {direction}"
