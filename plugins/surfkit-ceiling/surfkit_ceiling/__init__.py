"""Drop what floats above, or lies below, a scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from surfkit.plugin import BadInput, Component, Edit, Points, Prune, Step, StepCount, hookimpl


@dataclass(frozen=True)
class Ceiling(Prune):
    """Drop points beyond a height along one axis, every so many steps."""

    height: float = 1.0
    """Where the limit is, in the scene's local frame, whose extent is 1."""

    axis: Literal["x", "y", "z"] = "z"
    """ProgressPictures which axis heights are measured."""

    drop: Literal["above", "below"] = "above"
    """Which side goes."""

    every: Annotated[int, StepCount(floor=25)] = 100
    """Steps between edits."""

    def __post_init__(self) -> None:
        if self.every < 1:
            raise BadInput(f"ceiling.every is {self.every}; it must be 1 or more steps")

    def edit(self, points: Points, step: Step) -> Edit | None:
        """Drop the points on the wrong side."""
        if step.index % self.every:
            return None
        beyond = points.params["means"][:, "xyz".index(self.axis)] - self.height
        return Edit(drop=beyond > 0 if self.drop == "above" else beyond < 0)


@hookimpl
def surfkit_components() -> Mapping[str, type[Component]]:
    """The policy under the name that recipes use."""
    return {"ceiling": Ceiling}
