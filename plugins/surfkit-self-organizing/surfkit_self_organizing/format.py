"""SOG files whose pictures are smooth (Morgenstern et al. 2024)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from surfkit.plugin import SOG, SplatTable
from surfkit_self_organizing.attributes import grid_order, table_attributes


@dataclass(frozen=True)
class GridSOG(SOG):
    """SOG files whose splats are sorted into smooth pictures (Self-Organizing Gaussians, Morgenstern et al. 2024).

    The images are those of `format:sog`, which has its splats along a Morton curve, and every program that reads such
    files reads these. For splats that were trained with `regularizer:smooth-grid`. A million splats take some minutes.
    """

    suffix: ClassVar[str] = ".grid.sog"

    def order(self, table: SplatTable) -> np.ndarray:
        """See `SOG.order`."""
        return grid_order(table_attributes(table), 0)
