"""What the paper of CityGaussianV2 compares each of its scenes with: how the truth is thinned and cropped."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

PresetName = Literal["gauu-residence", "gauu-russian", "gauu-modern", "matrixcity-aerial", "matrixcity-street"]

VOXEL_M = 0.35
"""To which the paper thins every truth, metres; tau follows from the spacing that this leaves, 0.3 m to 0.6 m."""


@dataclass(frozen=True)
class Preset:
    """Settings of a comparison that belong to a scene.

    Attributes:
        visible: Number of training views, out of all of the scene, that must see a point of the truth.
        voxel_m: Voxel size to which the truth is thinned, metres.
    """

    visible: int
    voxel_m: float = VOXEL_M


PRESETS: dict[PresetName, Preset] = {
    "gauu-residence": Preset(visible=95),
    "gauu-russian": Preset(visible=125),
    "gauu-modern": Preset(visible=90),
    "matrixcity-aerial": Preset(visible=125),
    "matrixcity-street": Preset(visible=815),
}
"""By name; the numbers of views are those of the released code, whose paper does not state them."""
