"""SOG files whose pictures are smooth (Morgenstern et al. 2024)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from surfkit.plugin import SOG, Format, SplatTable
from surfkit_self_organizing.attributes import grid_order, table_attributes


@dataclass(frozen=True)
class GridSOG(SOG):
    """SOG files whose splats are sorted into smooth pictures (Self-Organizing Gaussians, Morgenstern et al. 2024).

    The images are those of `format:sog`, which has its splats along a Morton curve, and reads these files too, as every
    program does that reads such. For splats that were trained with `regularizer:smooth-grid`. A million splats take
    some minutes.
    """

    suffix: ClassVar[str] = ".grid.sog"

    read = Format.read  # nothing in a file tells it from others: `format:sog` knows and reads them all

    def knows(self, path: Path, head: bytes) -> bool:
        """See `Format.knows`."""
        return False

    def order(self, table: SplatTable) -> np.ndarray:
        """See `SOG.order`."""
        return grid_order(table_attributes(table), 0)
