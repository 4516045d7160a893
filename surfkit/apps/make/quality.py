"""What `surfkit make --quality` stands for: recipes and settings that are there, under one word."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

from surfkit.io.datasets.data import DEFAULT_LONGEST_PX, ReadSettings
from surfkit.raster.select import Device, torch_device
from surfkit.runs.recipe import Recipe

QualityName = Literal["draft", "normal", "high"]
DRAFT_STEPS = 500
"""Steps of a first look, as `surfkit doctor` recommends it."""
DRAFT_LONGEST_PX = 800
FIXED_SECONDS, MEGAPIXEL_SECONDS = 40.0, 6.0
"""What texture, maps and reports take on 2 cores: of even the smallest survey, and for a megapixel of its photographs.
Measured on two surveys (bench/log/field.md)."""


@dataclass(frozen=True)
class Quality:
    """One of the presets.

    Attributes:
        recipe: Name of the recipe.
        longest: Longest side of the photographs, pixels; None takes them as large as they are.
        at_most: Most steps.
        times: By which the usual number of steps is multiplied.
        divides: Whether the scene is divided into blocks where one model cannot hold it.
    """

    recipe: str
    longest: int | None
    at_most: int | None = None
    times: int = 1
    divides: bool = True

    def reading(self, given: ReadSettings) -> ReadSettings:
        """How photographs are read: at the size of the preset, unless the user has given one."""
        if given.longest is not None or given.scale is not None:
            return given
        if self.longest is None:
            return replace(given, scale=1.0)
        return replace(given, longest=self.longest)

    def steps(self, recipe: Recipe, photographs: int, device: Device) -> int:
        """Optimisation steps, if nobody says.

        Args:
            recipe: Of the preset.
            photographs: To train on.
            device: Where.
        """
        usual = recipe.start.usual_steps(photographs, torch_device(device).type == "cuda") or recipe.pretrain.steps
        return min(self.times * usual, self.at_most or self.times * usual)


QUALITIES: dict[QualityName, Quality] = {
    # At its 5 pixels between points a draft is so small that no memory is too small for it.
    "draft": Quality("surface-short", DRAFT_LONGEST_PX, DRAFT_STEPS, divides=False),
    "normal": Quality("surface", DEFAULT_LONGEST_PX),
    "high": Quality("surface", None, times=2),
}
