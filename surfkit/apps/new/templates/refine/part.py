"""An optimisation of the colours alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from surfkit.plugin import BadInput, LearningRate, Primitive, Refine, Stage

KEPT = {name: LearningRate(0.0) for name in ("means", "scales", "quats", "opacities")}
"""Learning rates of what stays as it is."""


@dataclass(frozen=True)
class NewPart(Refine):
    """Optimise the colours of the finished model alone: points neither move nor change their shape."""

    stage: Stage = field(default_factory=lambda: Stage(steps=2_000, densify=None, rates=KEPT))
    """The optimisation."""

    def refuse_unfit(self, primitive: Primitive) -> None:
        """See `Refine.refuse_unfit`."""
        if "sh0" not in primitive.columns():
            raise BadInput("new-part optimises the column sh0, which the primitive does not have; leave it out")


CHANGE: Mapping[str, Any] = {"refine": (NewPart(),)}
"""What puts the part into a recipe, by dotted path."""
