"""What a compressor is: it chooses an encoding for every column of a model."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from surfkit.compress.encoding import ColumnType, Encoding
from surfkit.core.check import BadInput
from surfkit.core.registry import Component, name_of
from surfkit.primitives.model import SplatModel
from surfkit.primitives.points import Columns


@dataclass(frozen=True)
class Plan:
    """How a model becomes a file.

    Attributes:
        encodings: Together they take every column of the points once.
        tables: What all leaves share, such as codebooks, by name; arrays of float16, float32, float64, uint8 or uint16.
        marks: What encodings want to know of each point beside its columns, (N, ...) each.
    """

    encodings: tuple[Encoding, ...]
    tables: Mapping[str, np.ndarray] = field(default_factory=dict)
    marks: Columns = field(default_factory=dict)


class Compressor(Component):
    """A way to make a model smaller."""

    needs_importance: ClassVar[bool] = False
    """Whether it wants to know how much each point contributes to the training views."""

    @abstractmethod
    def plan(
        self, model: SplatModel, importance: Tensor | None, seed: int, device: torch.device = torch.device("cpu")
    ) -> Plan:
        """How to encode the model.

        Args:
            model: All of its columns finite, on the CPU, N points.
            importance: (N,) mean contribution over the training views, if the compressor `needs_importance`.
            seed: Of every random draw.
            device: Where to do what takes long, if the compressor can; its plan is on the CPU.

        Raises:
            BadInput: It cannot compress such a model.
        """

    def coarser(self, factor: float) -> Compressor:
        """The same with errors `factor` times as large, for a wanted size or loss; smaller errors for factors below 1.

        Raises:
            BadInput: It has no setting for that.
        """
        raise BadInput(f"compress:{name_of(self)} has no setting for size against loss; choose compress:packed")


def kinds_of(model: SplatModel) -> dict[str, ColumnType]:
    """What is known of the columns of the points, without their values."""
    declared = model.primitive.columns()
    points = model.primitive.per_point(model.params)
    return {
        name: ColumnType(tuple(value.shape[1:]), torch.float64 if value.dtype == torch.float64 else torch.float32,
                     declared[name].activation)
        for name, value in points.items()
    }  # fmt: skip
