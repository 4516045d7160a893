"""Places near the borders between the blocks that a scene was cut into."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from surfkit.evaluate.geometry.scores import WORKERS, tree
from surfkit.evaluate.geometry.surface_file import BLOCK_POINTS


@dataclass(frozen=True)
class Seams:
    """Borders of blocks, and how near is near.

    Attributes:
        borders: (M, 2) places along the borders on the ground, much closer to each other than `reach`; local frame.
        ground: (2, 3) unit vectors that span the ground; local frame.
        reach: Local units.
        distance: The same length for people, with its unit.
    """

    borders: np.ndarray
    ground: np.ndarray
    reach: float
    distance: str

    def near(self, points: np.ndarray) -> np.ndarray:
        """(n,) bool: which of (n, 3) points of the local frame lie above or below a place within `reach`."""
        found = np.zeros(len(points), bool)
        if not len(self.borders):
            return found
        there = tree(self.borders)
        for start in range(0, len(points), BLOCK_POINTS):
            part = slice(start, start + BLOCK_POINTS)
            flat = np.asarray(points[part], np.float64) @ self.ground.T
            found[part] = np.isfinite(there.query(flat, distance_upper_bound=self.reach, workers=WORKERS)[0])
        return found
