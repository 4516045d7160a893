"""Which sparse points were seen where, as structure from motion found them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from surfkit.scene.scene import View


@dataclass(frozen=True)
class Observations2D:
    """The sparse points that one photograph shows.

    Attributes:
        points: (K,) int64 rows of `Observations.xyz`.
        at: (K, 2) float64 where, as shares of the width and height of the photograph.
    """

    points: np.ndarray
    at: np.ndarray


@dataclass(frozen=True)
class Observations:
    """The tracks of a sparse model.

    Attributes:
        xyz: (P, 3) float64, local frame.
        error_px: (P,) float64 mean reprojection error at the size of the sparse model's photographs.
        seen: By name of the photograph.
    """

    xyz: np.ndarray
    error_px: np.ndarray
    seen: Mapping[str, Observations2D]

    @property
    def is_empty(self) -> bool:
        """Whether no photograph is known to show any point."""
        return not any(len(seen.points) for seen in self.seen.values())

    def of(self, view: View, max_error_px: float = np.inf) -> tuple[np.ndarray, np.ndarray]:
        """Where a photograph shows points, and how deep they are.

        Args:
            view: The photograph.
            max_error_px: Only points with a smaller reprojection error.

        Returns:
            (K, 2) shares of width and height, within the photograph; (K,) inverse camera z, 1/local units, above 0.
        """
        seen = self.seen.get(view.name)
        if seen is None:
            return np.zeros((0, 2)), np.zeros(0)
        pose = view.camera.world_to_camera.cpu().numpy()
        z = self.xyz[seen.points] @ pose[2, :3] + pose[2, 3]
        inside = ((seen.at >= 0) & (seen.at <= 1)).all(1)
        good = inside & (z > 0) & (self.error_px[seen.points] < max_error_px)
        return seen.at[good], 1 / z[good]
