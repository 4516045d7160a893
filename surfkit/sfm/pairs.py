"""Which photographs are compared: all of a small set, else neighbours by GPS, by time or name, or by likeness.

Likeness needs no vocabulary from elsewhere: a photograph is summed up by a vector of locally aggregated descriptors
(VLAD; Jegou et al., CVPR 2010) over clusters of the set's own features.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.cluster.vq import kmeans2, vq
from scipy.spatial import cKDTree

from surfkit.scene.earth import geocentric
from surfkit.sfm.photographs import Photo
from surfkit.sfm.settings import Settings

SMALL = 60
"""Up to so many photographs are all compared with one another."""
WITH_GPS = 0.8
"""Share of photographs with a position from which `auto` relies on GPS."""
STEPS = 3
"""Neighbours before and after by time or name that are compared too, where positions may be wrong or lacking."""
WORDS, SAMPLE, PER_PHOTO = 64, 20_000, 300
"""Clusters of descriptors; descriptors that they are made from; and that are taken of a photograph."""

Pair = tuple[int, int]


def choose_pairs(photos: Sequence[Photo], settings: Settings, descriptors: Callable[[int], np.ndarray]) -> list[Pair]:
    """Positions of the photographs to compare, each pair once, the smaller first, in order.

    Args:
        photos: With enough features.
        settings: How they are chosen.
        descriptors: Gives the (K, 128) uint8 descriptors of a photograph by its position.
    """
    way, count = settings.pairs, len(photos)
    with_gps = sum(photo.exif.position is not None for photo in photos)
    if way == "auto":
        way = "exhaustive" if count <= SMALL else "gps" if with_gps >= WITH_GPS * count else "retrieval"
    if way == "exhaustive":
        return [(first, second) for second in range(count) for first in range(second)]
    order = in_order(photos)
    if way == "sequence":
        return sorted(sequence(order, max(1, settings.neighbours // 2)))
    chosen = sequence(order, STEPS)
    if way == "gps":
        chosen |= near(photos, settings.neighbours)
    if way == "retrieval" or with_gps < count:
        chosen |= alike(count, settings.neighbours, descriptors, settings.seed)
    return sorted(chosen)


def in_order(photos: Sequence[Photo]) -> list[int]:
    """Positions of photographs as they were taken: by time where all say it, else by name; by camera first."""
    timed = all(photo.exif.taken for photo in photos)
    return sorted(
        range(len(photos)),
        key=lambda at: (photos[at].exif.camera or "", (photos[at].exif.taken or "") if timed else "", photos[at].name),
    )


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
    xyz = geocentric(known[:, 0], known[:, 1], known[:, 2])
    _, found = cKDTree(xyz).query(xyz, min(count + 1, len(placed)))
    return {
        (min(at, placed[other]), max(at, placed[other]))
        for at, row in zip(placed, found, strict=True)
        for other in row
        if placed[other] != at
    }


def alike(count: int, most: int, descriptors: Callable[[int], np.ndarray], seed: int) -> set[Pair]:
    """Each of `count` photographs with the `most` that look most like it."""
    if count < 2:
        return set()
    rng = np.random.default_rng(seed)
    taken = rng.permutation(count)[: max(1, SAMPLE // PER_PHOTO)]
    sample = np.concatenate([_some(descriptors(int(at)), PER_PHOTO, rng) for at in taken])
    words, _ = kmeans2(sample, min(WORDS, len(sample)), minit="++", seed=rng)
    vectors = np.stack([vlad(descriptors(at).astype(np.float32), words) for at in range(count)])
    pairs = set()
    for at in range(count):
        likeness = vectors @ vectors[at]
        likeness[at] = -np.inf
        for other in np.argsort(-likeness, kind="stable")[: min(most, count - 1)].tolist():
            pairs.add((min(at, other), max(at, other)))
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
