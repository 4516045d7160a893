"""Points of many views thinned to one per voxel, in memory that does not grow with the views.

Voxels have sizes of 1, 2, 4 and so on times the smallest: what is far from its camera is known less finely, and would
stay a point for each pixel of each view in small ones. Those of all sizes share one grid.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from surfkit.scene.set_membership import is_among

VOXEL_INDEX_BITS = 19
"""Bits of the index of a voxel along each axis."""
MAX_VOXEL_LEVELS = 31
"""Maximum number of voxel sizes."""
MIN_MERGED_VOXELS = 1 << 19
"""Minimum number of buffered voxels before they are merged into the sorted ones."""
DUPLICATE_VOXEL_SHARE = 0.5
"""Points closer to each other than this share of a voxel are duplicates, from voxels whose corners cut a surface."""
MIN_KEPT_VOXELS, VOXELS_PER_POINT = 1 << 20, 6
"""Voxels kept while points are collected, at least, and for each point that may be made."""
NOISE_RADIUS_VOXELS, NOISE_NEIGHBOURS = 3.0, 3
"""A point with fewer others within this many voxel sizes is noise."""
WEIGHT_COLUMN, PLACE_COLUMNS, COLOR_COLUMNS, NORMAL_COLUMNS = 0, slice(1, 4), slice(4, 7), slice(7, 10)
"""Columns of the sums."""


@dataclass(frozen=True)
class Thinned:
    """Points, one for each voxel that has any.

    Attributes:
        xyz: (P, 3) float64 weighted means.
        rgb: (P, 3) float64 weighted means.
        normals: (P, 3) float64 unit vectors.
        weight: (P,) float64 sums.
        size: (P,) float64 side of the voxel.
    """

    xyz: np.ndarray
    rgb: np.ndarray
    normals: np.ndarray
    weight: np.ndarray
    size: np.ndarray

    def __len__(self) -> int:
        return len(self.xyz)

    @classmethod
    def none(cls) -> Thinned:
        """No points."""
        return cls(*np.zeros((3, 0, 3)), *np.zeros((2, 0)))

    def take(self, rows: np.ndarray) -> Thinned:
        """A selection of the points."""
        return Thinned(*(value[rows] for value in vars(self).values()))

    def joined(self, other: Thinned) -> Thinned:
        """These points, then others."""
        return Thinned(*map(np.concatenate, zip(vars(self).values(), vars(other).values(), strict=True)))


@dataclass(frozen=True)
class Samples:
    """Points of one view.

    Attributes:
        xyz: (M, 3).
        rgb: (M, 3).
        normals: (M, 3) unit vectors.
        weight: (M,) above 0.
        grain: (M,) how finely each is known: the side of the smallest voxel that it may lie in.
    """

    xyz: np.ndarray
    rgb: np.ndarray
    normals: np.ndarray
    weight: np.ndarray
    grain: np.ndarray


@dataclass(frozen=True)
class Voxels:
    """Weighted sums by voxel.

    Attributes:
        side: Of the smallest voxels.
        keys: (M,) int64 level and indices of each voxel, ascending.
        sums: (M, 10) float32: weight, then weighted position, colour and normal.
    """

    side: float
    keys: np.ndarray
    sums: np.ndarray

    def __len__(self) -> int:
        return len(self.keys)

    @classmethod
    def of(cls, side: float, samples: Samples) -> Voxels:
        """The voxels of samples, the smallest of this side."""
        level = np.round(np.log2(np.maximum(samples.grain / side, 1)))
        weight = samples.weight[:, None]
        sums = np.empty((len(weight), 10), np.float32)
        sums[:, WEIGHT_COLUMN] = samples.weight
        sums[:, PLACE_COLUMNS], sums[:, COLOR_COLUMNS] = weight * samples.xyz, weight * samples.rgb
        sums[:, NORMAL_COLUMNS] = weight * samples.normals
        return _summed(side, *_encoded(side, samples.xyz, level, sums))

    def level(self) -> np.ndarray:
        """(M,) of each voxel: its side is 2**level times the smallest."""
        return self.keys >> (3 * VOXEL_INDEX_BITS)

    def means(self) -> np.ndarray:
        """(M, 3) float64 mean positions."""
        return self.sums[:, PLACE_COLUMNS].astype(np.float64) / self.sums[:, :1]

    def at(self, side: float) -> Voxels:
        """The same points in larger voxels, each at the mean of those that it had been averaged to."""
        level = self.level()
        wanted = np.where(level > 0, np.round(np.log2(np.maximum(self.side * 2.0**level / side, 1))), 0)
        return _summed(side, *_encoded(side, self.means(), wanted, self.sums))

    def without(self, rows: np.ndarray) -> Voxels:
        """The voxels without a selection."""
        return replace(self, keys=self.keys[~rows], sums=self.sums[~rows])

    def away_from(self, points: Thinned) -> Voxels:
        """Without the voxels that went into points to be dropped, none of which has many others near it."""
        from scipy.spatial import cKDTree

        diagonal = np.sqrt(3) * points.size
        distance, near = cKDTree(points.xyz).query(self.means(), distance_upper_bound=diagonal.max())
        return self.without(distance < np.append(diagonal, 0.0)[near])


class VoxelAccumulator:
    """Voxels of all views so far; their size is doubled when there are too many."""

    def __init__(self, side: float, most: int) -> None:
        """Empty; `side`: of the smallest voxels; `most`: how many are kept."""
        self.voxels = Voxels(side, np.zeros(0, np.int64), np.zeros((0, 10), np.float32))
        self.most = most
        self.waiting: list[Voxels] = []

    @classmethod
    def for_points(cls, side: float, points: int) -> VoxelAccumulator:
        """Empty, with memory for as many voxels as so many points need."""
        return cls(side, max(MIN_KEPT_VOXELS, VOXELS_PER_POINT * points))

    def add(self, samples: Samples) -> None:
        """Add the points of a view."""
        self.waiting.append(Voxels.of(self.voxels.side, samples))
        if sum(map(len, self.waiting)) > max(len(self.voxels), MIN_MERGED_VOXELS):
            self.settle()

    def settle(self) -> Voxels:
        """Merge the buffered voxels, and return all."""
        parts, side = [self.voxels, *self.waiting], self.voxels.side
        self.waiting = []
        keys, sums = np.concatenate([p.keys for p in parts]), np.concatenate([p.sums for p in parts])
        self.voxels = _summed(side, keys, sums)
        while len(self.voxels) > self.most:
            self.voxels = self.voxels.at(2 * self.voxels.side)
        return self.voxels


def thin(voxels: Voxels, side: float) -> Thinned:
    """One point for each voxel of a size; where finer voxels have seen the same place, those alone count."""
    found = voxels if side == voxels.side else voxels.at(side)
    found = found.without(_seen_finer(found))
    sums = found.sums.astype(np.float64)
    weight = sums[:, :1]
    length = np.linalg.norm(sums[:, NORMAL_COLUMNS], axis=1, keepdims=True)
    normals = np.where(length > 1e-6 * weight, sums[:, NORMAL_COLUMNS] / np.maximum(length, 1e-30), (0.0, 0.0, 1.0))
    size = side * 2.0 ** found.level()
    points = Thinned(sums[:, PLACE_COLUMNS] / weight, sums[:, COLOR_COLUMNS] / weight, normals, weight[:, 0], size)
    keep = np.ones(len(points), bool)
    for each in np.unique(size):
        rows = np.flatnonzero(size == each)
        keep[rows] = apart(points.xyz[rows], points.weight[rows], DUPLICATE_VOXEL_SHARE * each)
    return points.take(keep)


def thin_to(voxels: Voxels, most: int) -> Thinned:
    """As many points as there are, at most `most`, and not fewer by more than 2 % if there are more.

    The size of the voxels is found by steps that would be exact on a plane, kept within what was too much and too few.
    Where no size gives so few, as voxels around the origin never become one, the heaviest points are taken.
    """
    found = thin(voxels, voxels.side)
    if len(found) <= most:
        return found
    best, low, high = None, voxels.side, np.inf
    side = low * max(1.01, np.sqrt(len(found) / most))
    for _ in range(24):
        found = thin(voxels, side)
        if len(found) <= most and (best is None or len(found) > len(best)):
            best = found
        if 0.98 * most <= len(found) <= most:
            break
        low, high = (side, high) if len(found) > most else (low, side)
        side *= np.sqrt(max(len(found), 1) / (0.99 * most))
        if not low < side < high:
            side = 2 * low if high == np.inf else (low + high) / 2
    return found.take(np.argsort(-found.weight, kind="stable")[:most]) if best is None else best


def apart(xyz: np.ndarray, weight: np.ndarray, radius: float) -> np.ndarray:
    """(P,) which points to keep so that none lies within a radius of another: heavier ones first, then earlier ones."""
    from scipy.spatial import cKDTree

    dropped = np.zeros(len(xyz), bool)
    pairs = cKDTree(xyz).query_pairs(radius, output_type="ndarray") if len(xyz) else np.zeros((0, 2), int)
    rank = np.empty(len(xyz), np.int64)
    rank[np.lexsort((np.arange(len(xyz)), -weight))] = np.arange(len(xyz))
    swap = rank[pairs[:, 0]] > rank[pairs[:, 1]]
    pairs[swap] = pairs[swap][:, ::-1]
    while len(pairs):
        beaten = np.zeros(len(xyz), bool)  # there is a heavier one near, of which it is not known whether it stays
        beaten[pairs[:, 1]] = True
        dropped[pairs[~beaten[pairs[:, 0]], 1]] = True
        pairs = pairs[~dropped[pairs].any(1)]
        pairs = pairs[beaten[pairs[:, 0]]]
    return ~dropped


def find_isolated(points: Thinned) -> np.ndarray:
    """(P,) which points have too few others near them to be a surface."""
    from scipy.spatial import cKDTree

    if len(points) <= NOISE_NEIGHBOURS:
        return np.ones(len(points), bool)
    distances, _ = cKDTree(points.xyz).query(points.xyz, k=NOISE_NEIGHBOURS + 1)
    return distances[:, -1] > NOISE_RADIUS_VOXELS * points.size


def _seen_finer(voxels: Voxels) -> np.ndarray:
    """(M,) whether a finer voxel that has points lies in a voxel."""
    level, place = voxels.level(), voxels.means()
    seen = np.zeros(len(voxels), bool)
    for each in np.unique(level)[1:]:
        finer, here = level < each, level == each
        inside, _ = _encoded(voxels.side, place[finer], np.full(int(finer.sum()), float(each)), place[finer])
        seen[here] = is_among(voxels.keys[here], inside)
    return seen


def _encoded(side: float, xyz: np.ndarray, level: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Keys of the voxels of points, and their values; without points that lie beyond all voxels.

    A voxel is larger than asked for where its index would be too large.
    """
    half = 1 << (VOXEL_INDEX_BITS - 1)
    reach = np.abs(xyz).max(axis=1, initial=0) / (side * (half - 1))
    level = np.maximum(level, np.ceil(np.log2(np.maximum(reach, 1)))).astype(np.int64)
    there = level <= MAX_VOXEL_LEVELS
    level, xyz, values = level[there], xyz[there], values[there]
    index = np.floor(xyz / (side * 2.0 ** level[:, None])).astype(np.int64) + half
    return ((level << VOXEL_INDEX_BITS | index[:, 0]) << VOXEL_INDEX_BITS | index[:, 1]) << VOXEL_INDEX_BITS | index[
        :, 2
    ], values


def _summed(side: float, keys: np.ndarray, sums: np.ndarray) -> Voxels:
    """Rows of the same key added up, in the order in which they came."""
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    first = np.flatnonzero(np.diff(keys, prepend=keys[:1] - 1))
    total = np.add.reduceat(sums[order], first, axis=0) if len(keys) else sums
    return Voxels(side, keys[first], total)
