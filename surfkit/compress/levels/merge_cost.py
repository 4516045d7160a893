"""Which splats are merged: pairs of near and alike ones, then pairs of these, until few enough are left."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

PAIR_NEIGHBOURS = 8
"""Splats that each may be paired with."""
SPACING_COST = 0.01
"""Cost of lying apart by the median distance of nearest neighbours, squared, where 1 is that of black and white."""
TURN_COST = 0.1
"""Cost of flat splats that lie at right angles."""
MIN_SQUARED_SPACING = 1e-20
"""Squared length, where neighbours lie in one place."""


@dataclass(frozen=True)
class MergeCost:
    """What tells which of N splats are near and alike, all float64.

    Attributes:
        means: (N, 3) places.
        weights: (N,) above 0, how much each counts.
        colors: (N, 3) constant part of the colour, 0 to 1.
        normals: (N, 3) directions, of either sign, as long as the splat is flat: 1 for a disc, 0 for a ball.
    """

    means: np.ndarray
    weights: np.ndarray
    colors: np.ndarray
    normals: np.ndarray

    def __len__(self) -> int:
        return len(self.means)

    def cost(self, i: np.ndarray, j: np.ndarray, spacing: float) -> np.ndarray:
        """What is lost by merging `i` with `j`: their differences, times the harmonic mean of their weights.

        Args:
            i, j: (E,) positions.
            spacing: Squared length that `SPACING_COST` is about.
        """
        apart = ((self.means[i] - self.means[j]) ** 2).sum(1) / spacing
        other = ((self.colors[i] - self.colors[j]) ** 2).sum(1)
        lengths = np.linalg.norm(self.normals[i], axis=1) * np.linalg.norm(self.normals[j], axis=1)
        turned = lengths - np.abs((self.normals[i] * self.normals[j]).sum(1))
        weight = self.weights[i] * self.weights[j] / (self.weights[i] + self.weights[j])
        return weight * (SPACING_COST * apart + other + TURN_COST * turned)

    def merged(self, labels: np.ndarray, partner: np.ndarray) -> MergeCost:
        """The same of groups; `partner` (N,) is the position of the first of each splat's group."""
        total = summed(self.weights, labels)
        sign = np.where((self.normals * self.normals[partner]).sum(1) < 0, -1.0, 1.0)

        def mean(values: np.ndarray) -> np.ndarray:
            return summed(values * self.weights[:, None], labels) / total[:, None]

        return MergeCost(mean(self.means), total, mean(self.colors), mean(self.normals * sign[:, None]))


def summed(values: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """(G, ...) sums of (N, ...) values by label 0..G-1, each label used; in the order of the rows."""
    order = np.argsort(labels, kind="stable")
    starts = np.searchsorted(labels[order], np.arange(int(labels.max()) + 1))
    return np.add.reduceat(values[order], starts, axis=0)


def groups(alike: MergeCost, target: int) -> np.ndarray:
    """(N,) labels 0..target-1 of N splats that become `target`: those that lose least are merged first.

    In each round every splat that is its best partner's best partner is merged with it, so that the result depends on
    no order and no number of threads.
    """
    labels = np.arange(len(alike))
    spacing = None
    while len(alike) > target:
        low, high, squared = _edges(alike.means)
        spacing = spacing or max(float(np.median(squared)), MIN_SQUARED_SPACING)
        cost = alike.cost(low, high, spacing)
        rank = np.empty(len(low), np.int64)
        rank[np.lexsort((high, low, cost))] = np.arange(len(low))
        best = np.full(len(alike), len(low))
        np.minimum.at(best, low, rank)
        np.minimum.at(best, high, rank)
        chosen = ((best[low] == rank) & (best[high] == rank)).nonzero()[0]
        chosen = chosen[np.argsort(rank[chosen])][: len(alike) - target]
        partner = np.arange(len(alike))
        partner[high[chosen]] = low[chosen]
        _, joined = np.unique(partner, return_inverse=True)
        alike, labels = alike.merged(joined, partner), joined[labels]
    return labels


def _edges(means: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pairs of neighbours, lower position first, each once, and (N,) squared distances to the nearest other place."""
    from scipy.spatial import cKDTree

    count = min(PAIR_NEIGHBOURS + 1, len(means))
    distances, found = cKDTree(means).query(means, k=count)
    here = np.repeat(np.arange(len(means)), count)
    there = found.reshape(-1)
    low, high = np.minimum(here, there), np.maximum(here, there)
    keys = np.unique((low * len(means) + high)[low < high])
    return keys // len(means), keys % len(means), distances[:, 1] ** 2
