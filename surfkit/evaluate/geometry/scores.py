"""How close two clouds of points are: precision, recall, F1 and chamfer distances."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from surfkit.evaluate.geometry.surface_file import BLOCK_POINTS

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

WORKERS = 2
"""Threads that look for neighbours."""


@dataclass(frozen=True)
class Distances:
    """Between two clouds, both ways.

    Attributes:
        to_truth: (n,) from each point of the reconstruction to the nearest of the truth.
        to_reconstruction: (m,) from each point of the truth to the nearest of the reconstruction.
    """

    to_truth: np.ndarray
    to_reconstruction: np.ndarray


def tree(points: np.ndarray) -> cKDTree:
    """A search tree (scipy's cKDTree) of (n, 3) points."""
    from scipy.spatial import cKDTree

    return cKDTree(points, balanced_tree=False, compact_nodes=False)


def nearest(there: cKDTree, points: np.ndarray) -> np.ndarray:
    """(n,) float64 distances of (n, 3) points to the nearest point of a tree."""
    parts = [
        there.query(points[start : start + BLOCK_POINTS], workers=WORKERS)[0]
        for start in range(0, len(points), BLOCK_POINTS)
    ]
    return np.concatenate(parts) if parts else np.empty(0)


def nearest_rows(there: cKDTree, points: np.ndarray) -> np.ndarray:
    """(n,) rows, in the tree, of the point nearest to each of (n, 3) points."""
    parts = [
        there.query(points[start : start + BLOCK_POINTS], workers=WORKERS)[1]
        for start in range(0, len(points), BLOCK_POINTS)
    ]
    return np.concatenate(parts) if parts else np.empty(0, np.int64)


def spacing(there: cKDTree, points: np.ndarray) -> float:
    """Mean distance of points to their nearest neighbour other than themselves, in the tree of all of them."""
    return float(there.query(points, k=2, workers=WORKERS)[0][:, 1].mean())


def surface_gap(there: cKDTree, points: np.ndarray) -> float:
    """1 / sqrt(points per area) of a surface that points were drawn from in any way, by the distance to the eighth."""
    eighth = there.query(points, k=[9], workers=WORKERS)[0][:, 0]
    return float(np.sqrt(np.pi / 8) * eighth[np.isfinite(eighth)].mean()) if np.isfinite(eighth).any() else 0.0


def between(reconstruction: np.ndarray, truth: np.ndarray) -> Distances:
    """Distances between (n, 3) and (m, 3) points, both ways."""
    return Distances(nearest(tree(truth), reconstruction), nearest(tree(reconstruction), truth))


def shares(distances: Distances, tau: float) -> tuple[float, float, float]:
    """Precision, recall and F1 at a threshold: shares of both clouds less than `tau` from the other, and their mean."""
    precision = float((distances.to_truth < tau).mean())
    recall = float((distances.to_reconstruction < tau).mean())
    return precision, recall, 2 * precision * recall / (precision + recall) if precision + recall else 0.0


def chamfer(distances: Distances, far: float | None = None) -> dict[str, float | None]:
    """Mean distance each way and the mean of both, as the DTU benchmark has them.

    Args:
        distances: Both ways.
        far: Distances above this do not count, as DTU leaves out those above 20 mm.
    """

    def mean(values: np.ndarray) -> float | None:
        counted = values if far is None else values[values <= far]
        return float(counted.mean()) if len(counted) else None

    accuracy, completeness = mean(distances.to_truth), mean(distances.to_reconstruction)
    overall = None if accuracy is None or completeness is None else (accuracy + completeness) / 2
    return {"accuracy": accuracy, "completeness": completeness, "overall": overall}


def curve(distances: Distances, taus: np.ndarray) -> np.ndarray:
    """(T, 2) precision and recall at each of (T,) thresholds."""
    columns = [np.sort(values) for values in (distances.to_truth, distances.to_reconstruction)]
    return np.stack([np.searchsorted(values, taus, "left") / len(values) for values in columns], axis=1)
