"""Models as they are, and with half the bytes."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from surfkit.compress.base import Compressor, Plan, kinds_of
from surfkit.compress.scalars import Floats
from surfkit.primitives.model import SplatModel


@dataclass(frozen=True)
class Lossless(Compressor):
    """All numbers as they are, coded without loss."""

    def plan(
        self, model: SplatModel, importance: Tensor | None, seed: int, device: torch.device = torch.device("cpu")
    ) -> Plan:
        """See `Compressor.plan`."""
        return Plan(tuple(exact(name, str(kind.dtype)) for name, kind in kinds_of(model).items()))


@dataclass(frozen=True)
class Float16(Compressor):
    """Positions as they are, all other numbers rounded to float16."""

    def plan(
        self, model: SplatModel, importance: Tensor | None, seed: int, device: torch.device = torch.device("cpu")
    ) -> Plan:
        """See `Compressor.plan`."""
        found = {name: Floats(name, "float16") for name in kinds_of(model)}
        return Plan(tuple((found | {"means": exact("means", str(model.params["means"].dtype))}).values()))


def exact(name: str, dtype: str) -> Floats:
    """The encoding of a column of a torch dtype that loses nothing."""
    return Floats(name, dtype.removeprefix("torch."))
