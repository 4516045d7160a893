"""Files of half the size."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from surfkit.plugin import BadInput, Compressor, Plan, SplatModel
from surfkit.compress.scalars import Floats
from torch import Tensor


@dataclass(frozen=True)
class NewPart(Compressor):
    """Round chosen columns to float16, and keep the others as they are."""

    half: tuple[str, ...] = ("opacities", "sh0", "sh_rest")
    """Columns that are rounded; columns that a model does not have are left out."""

    def __post_init__(self) -> None:
        if "means" in self.half:
            raise BadInput("new-part.half names means; positions need more digits than float16 has")

    def plan(
        self, model: SplatModel, importance: Tensor | None, seed: int, device: torch.device = torch.device("cpu")
    ) -> Plan:
        """See `Compressor.plan`."""
        encodings = []
        for name, values in model.primitive.per_point(model.params).items():
            kept = "float64" if str(values.dtype) == "torch.float64" else "float32"
            encodings.append(Floats(name, "float16" if name in self.half else kept))
        return Plan(tuple(encodings))


CHANGE: Mapping[str, Any] = {"compress": NewPart()}
"""What puts the part into a recipe, by dotted path."""
