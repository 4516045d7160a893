"""Which photographs are compared: neighbours by their poses where these are known; else all of a small set, neighbours
by GPS, by time or name, or by likeness.

Likeness needs no vocabulary from elsewhere: a photograph is summed up by a vector of locally aggregated descriptors
(VLAD; Jegou et al., CVPR 2010) over clusters of the set's own features.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

import numpy as np
from scipy.cluster.vq import kmeans2, vq
from scipy.spatial import cKDTree

from surfkit.apps.sfm.inspect_photos import Photo
from surfkit.apps.sfm.settings import Settings
from surfkit.core.events import Progress, emit
from surfkit.scene.earth import geocentric

MAX_EXHAUSTIVE_PHOTOS = 60
"""Up to so many photographs are all compared with one another."""
MIN_GPS_SHARE = 0.8
"""Share of photographs with a position from which `auto` relies on GPS."""
SEQUENCE_NEIGHBOURS = 3
"""Neighbours before and after by time or name that are compared too, where positions may be wrong or lacking."""
VOCABULARY_SIZE, VOCABULARY_DESCRIPTORS, DESCRIPTORS_PER_PHOTO = 64, 20_000, 300
"""Clusters of descriptors; descriptors that they are made from; and that are taken of a photograph."""
LIKENESS_BATCH = 256
"""Photographs that are compared with all others in one matrix product: one by one, each would read all vectors."""

DISTANCE_NEIGHBOURS = 8
"""Neighbours that tell how far away what photographs show is."""
CAMERA_DISTANCE_WEIGHT = 0.5
"""Of a distance between two cameras, against one between the places that they look at."""
NEIGHBOUR_SPREAD_FACTOR = 1.5
"""Times as many neighbours, over which the farther half of those that are compared is spread."""
LOOK_AHEAD_FACTOR = 4.0
"""Times the distance to the last of the nearest: how far ahead parallel views are taken to look at least."""
MAX_SIMILAR_VIEW_DEGREES, MAX_PAIR_DEGREES = 45.0, 75.0
"""Degrees between viewing directions: up to which two photographs may tell that; from which they are not compared."""
BATCH_PHOTOS = 4096
"""Photographs whose candidates are looked at together."""

Pair = tuple[int, int]


def choose_pairs(
    photos: Sequence[Photo],
    settings: Settings,
    descriptors: Callable[[int], np.ndarray],
    poses: np.ndarray | None = None,
) -> list[Pair]:
    """Positions of the photographs to compare, each pair once, the smaller first, in order.

    Args:
        photos: With enough features.
        settings: How they are chosen.
        descriptors: Gives the (K, D) uint8 or float16 descriptors of a photograph by its position.
        poses: (N, 4, 4) float64 world_to_camera, if they are known; `auto` goes by them.
    """
    way, count = settings.pairs, len(photos)
    if way == "auto" and poses is not None:
        return sorted(facing(poses, settings.neighbours))
    with_gps = sum(photo.exif.position is not None for photo in photos)
    if way == "auto":
        way = (
            "exhaustive"
            if count <= MAX_EXHAUSTIVE_PHOTOS
            else "gps"
            if with_gps >= MIN_GPS_SHARE * count
            else "retrieval"
        )
    if way == "exhaustive":
        return [(first, second) for second in range(count) for first in range(second)]
    order = in_order(photos)
    if way == "sequence":
        return sorted(sequence(order, max(1, settings.neighbours // 2)))
    chosen = sequence(order, SEQUENCE_NEIGHBOURS)
    if way == "gps":
        chosen |= near(photos, settings.neighbours)
    lost = range(count) if way == "retrieval" else [at for at in order if photos[at].exif.position is None]
    if lost:
        chosen |= alike(count, settings.neighbours, descriptors, settings.seed, lost)
    return sorted(chosen)


def in_order(photos: Sequence[Photo]) -> list[int]:
    """Positions of photographs as they were taken: by time where all say it, else by name; by camera first.

    Numbers in names count as such, as cameras without EXIF often write them without zeros: 9 comes before 10.
    """
    timed = all(photo.exif.taken for photo in photos)

    def key(at: int) -> tuple[str, str, list[str | int]]:
        exif, parts = photos[at].exif, re.split(r"(\d+)", photos[at].name)  # every other part is a number
        numbered = [int(part) if place % 2 else part for place, part in enumerate(parts)]
        return exif.camera or "", (exif.taken or "") if timed else "", numbered

    return sorted(range(len(photos)), key=key)


def sequence(order: Sequence[int], steps: int) -> set[Pair]:
    """Each photograph with the next `steps` in an order."""
    return {
        (min(at, other), max(at, other))
        for place, at in enumerate(order)
        for other in order[place + 1 : place + 1 + steps]
    }


def near(photos: Sequence[Photo], count: int) -> set[Pair]:
    """Each photograph that has a position with the `count` nearest to it."""
    placed = [at for at, photo in enumerate(photos) if photo.exif.position is not None]
    if len(placed) < 2:
        return set()
    known = np.array([photos[at].exif.position for at in placed], np.float64)
    high = np.isfinite(known[:, 2])
    level = np.median(known[high, 2]) if high.any() else 0.0  # for those of no known altitude
    xyz = geocentric(known[:, 0], known[:, 1], np.where(high, known[:, 2], level))
    _, found = cKDTree(xyz).query(xyz, min(count + 1, len(placed)))
    return {
        (min(at, placed[other]), max(at, placed[other]))
        for at, row in zip(placed, found, strict=True)
        for other in row
        if placed[other] != at
    }


def facing(poses: np.ndarray, count: int) -> set[Pair]:
    """Each photograph with up to `count` that look at the same place from near by.

    Half of them are its nearest neighbours in six dimensions: where a camera stands, and the place that it looks at.
    The others are spread over those that come next, as the very nearest show little parallax. The time is that of a
    search tree, N log N.

    Args:
        poses: (N, 4, 4) float64 world_to_camera.
        count: Of neighbours.
    """
    turns = poses[:, :3, :3]
    centres, views = -(turns.transpose(0, 2, 1) @ poses[:, :3, 3:])[..., 0], turns[:, 2]
    places = np.hstack([CAMERA_DISTANCE_WEIGHT * centres, centres + distance_seen(centres, views) * views])
    tree, most = cKDTree(places), min(round(NEIGHBOUR_SPREAD_FACTOR * count) + 1, len(poses))
    near, pairs = (count + 1) // 2, set()
    for start in range(0, len(poses), BATCH_PHOTOS):
        _, found = tree.query(places[start : start + BATCH_PHOTOS], range(1, most + 1))
        for at, row in enumerate(found, start):
            row = row[(row != at) & (views[row] @ views[at] > np.cos(np.radians(MAX_PAIR_DEGREES)))]
            rest = row[near:]
            spread = np.linspace(0, len(rest) - 1, min(count - near, len(rest))).round().astype(int)
            pairs |= {(min(at, other), max(at, other)) for other in [*row[:near].tolist(), *rest[spread].tolist()]}
    return pairs


def distance_seen(centres: np.ndarray, views: np.ndarray) -> float:
    """About how far ahead cameras look at the same place as their neighbours: in the least squares, and at least so far
    that neighbours with parallel views overlap, which tell nothing else.

    Args:
        centres: (N, 3) float64.
        views: (N, 3) float64 unit vectors along the optical axes.
    """
    away, found = cKDTree(centres).query(centres, range(1, min(DISTANCE_NEIGHBOURS + 1, len(centres)) + 1))
    one, other = np.repeat(np.arange(len(centres)), found.shape[1]), found.ravel()
    used = (views[one] * views[other]).sum(1) > np.cos(np.radians(MAX_SIMILAR_VIEW_DEGREES))
    moved, turned = (values[other[used]] - values[one[used]] for values in (centres, views))
    least, weight = LOOK_AHEAD_FACTOR * float(np.median(away[:, -1])), float((turned**2).sum())
    return max(least, -float((moved * turned).sum()) / weight if weight > 1e-12 * len(centres) else 0.0)


def alike(
    count: int, most: int, descriptors: Callable[[int], np.ndarray], seed: int, wanted: Sequence[int]
) -> set[Pair]:
    """Each of the `wanted` of `count` photographs with the `most` that look most like it."""
    if count < 2:
        return set()
    rng = np.random.default_rng(seed)
    taken = rng.permutation(count)[: max(1, VOCABULARY_DESCRIPTORS // DESCRIPTORS_PER_PHOTO)]
    sample = np.concatenate([_some(descriptors(int(at)), DESCRIPTORS_PER_PHOTO, rng) for at in taken])
    words, _ = kmeans2(sample, min(VOCABULARY_SIZE, len(sample)), minit="++", seed=rng)
    vectors = np.empty((count, words.size), np.float32)
    for at in range(count):
        vectors[at] = vlad(descriptors(at).astype(np.float32), words)
        emit(Progress("summing up photographs", at + 1, count))
    pairs, of_each = set(), min(most, count - 1)
    for start in range(0, len(wanted), LIKENESS_BATCH):
        batch = np.asarray(wanted[start : start + LIKENESS_BATCH])
        likeness = vectors[batch] @ vectors.T
        likeness[np.arange(len(batch)), batch] = -np.inf
        for at, others in zip(batch.tolist(), np.argsort(-likeness, kind="stable")[:, :of_each].tolist(), strict=True):
            pairs |= {(min(at, other), max(at, other)) for other in others}
        emit(Progress("looking for photographs alike", start + len(batch), len(wanted)))
    return pairs


def vlad(descriptors: np.ndarray, words: np.ndarray) -> np.ndarray:
    """The vector of locally aggregated descriptors of a photograph.

    Args:
        descriptors: (K, D) float32.
        words: (W, D) centres of clusters.

    Returns:
        (W * D,) float32 of length 1; residuals to the nearest centres, summed, normalised by cluster.
    """
    nearest, _ = vq(descriptors, words)
    sums = np.zeros_like(words)
    np.add.at(sums, nearest, descriptors - words[nearest])
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-6)
    return (sums / max(float(np.linalg.norm(sums)), 1e-6)).ravel().astype(np.float32)


def _some(descriptors: np.ndarray, most: int, rng: np.random.Generator) -> np.ndarray:
    rows = rng.permutation(len(descriptors))[:most]
    return descriptors[np.sort(rows)].astype(np.float32)
