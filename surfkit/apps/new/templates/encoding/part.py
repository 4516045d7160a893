"""A way to store numbers of either sign, and files that use it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
import torch
from surfkit.plugin import BadInput, ColumnType, Columns, Compressor, Encoding, Leaf, Plan, SplatModel, choice
from surfkit.compress.encoding import Streams, Tables, flat, from_whole, multiples
from surfkit.compress.scalars import Floats
from torch import Tensor


@dataclass(frozen=True)
class NewPart(Encoding):
    """Square roots of numbers, with their signs, as multiples of a step: small numbers keep more digits."""

    column: str = "sh0"
    """Name of the column."""

    step: float = 0.02
    """Difference of the square roots that can be told apart."""

    def __post_init__(self) -> None:
        if not 0 < self.step <= 0.1:
            raise BadInput(f"new-part.step is {self.step:g}; it must be above 0 and at most 0.1")

    @property
    def columns(self) -> tuple[str, ...]:
        """See `Encoding.columns`."""
        return (self.column,)

    def encode(self, values: Columns, kinds: Mapping[str, ColumnType], leaf: Leaf, tables: Tables) -> Streams:
        """See `Encoding.encode`."""
        numbers = flat(values, self.column).astype(np.float64)
        return from_whole(self.column, np.rint(np.sign(numbers) * np.sqrt(np.abs(numbers)) / self.step))

    def decode(
        self, streams: Streams, kinds: Mapping[str, ColumnType], leaf: Leaf, count: int, tables: Tables
    ) -> Columns:
        """See `Encoding.decode`."""
        kind = kinds[self.column]
        roots = multiples(streams, self.column, count, kind.width, self.step)
        return {self.column: kind.rows(roots * np.abs(roots))}


@dataclass(frozen=True)
class NewPartFiles(Compressor):
    """Encode one column, and keep the others as they are."""

    encoding: Annotated[Encoding, choice(Encoding)] = field(default_factory=NewPart)
    """How it is encoded; columns that a model does not have are left out."""

    def plan(
        self, model: SplatModel, importance: Tensor | None, seed: int, device: torch.device = torch.device("cpu")
    ) -> Plan:
        """See `Compressor.plan`."""
        columns = model.primitive.per_point(model.params)
        chosen = [self.encoding] if set(self.encoding.columns) <= set(columns) else []
        taken = {name for encoding in chosen for name in encoding.columns}
        rest = {name: values for name, values in columns.items() if name not in taken}
        kinds = {name: str(values.dtype).removeprefix("torch.") for name, values in rest.items()}
        return Plan((*chosen, *(Floats(name, kind) for name, kind in kinds.items())))


CHANGE: Mapping[str, Any] = {"compress": NewPartFiles()}
"""What puts the part into a recipe, by dotted path."""
