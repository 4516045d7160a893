"""Vector quantisation: weighted k-means.

Lloyd's iterations from vectors drawn at random. As their result depends much on where they begin, each iteration also
merges codes that are close to one another, and splits in their place codes whose vectors lie far apart, wherever this
makes the sum smaller (after Patane and Russo 2001, "The enhanced LBG algorithm"). Assignments are exact and sums are
float64 in the order of the vectors, so a seed gives the same bits on any number of threads, with any instruction set,
without a compiler, and on a GPU.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from surfkit.compress.cuda import codes as gpu
from surfkit.compress.nearest import CPU, DistanceBounds, Search, checked, itself, nearest, searching
from surfkit.core.check import BadInput, expect
from surfkit.raster.native import kernels, module

__all__ = ["kmeans", "nearest"]

HALVINGS = 2
"""Times that the vectors of a code are halved, each in a better direction."""
VECTORS_PER_CODE = 64
"""Vectors for each code that the iterations look at, unless told otherwise."""
MIN_SAMPLED_VECTORS = 1 << 18
"""Vectors that the iterations look at in any case, unless told otherwise."""
DIRECTION_VECTORS = 1 << 16
"""Vectors of which the principal directions are taken."""

Progress = Callable[[int, int], None]


def kmeans(
    vectors: Tensor,
    codes: int,
    weights: Tensor | None = None,
    *,
    seed: int = 0,
    iterations: int = 10,
    sample: int | None = None,
    progress: Progress | None = None,
    device: torch.device = CPU,
) -> Tensor:
    """(codes, D) float32 centroids that make the weighted sum of squared distances to the nearest one small.

    Where no more than `codes` different vectors have a weight, the result is these, then others, then copies of the
    first. Codes without vectors, and those that can be spared, are moved to where the weighted error is largest. Memory
    is of the order of the arguments. No number of threads and no instruction set changes a bit, nor does a GPU, or a
    missing compiler, without which it takes some fifty times longer.

    Args:
        vectors: (N, D) float32.
        codes: Number of centroids, at least 1.
        weights: (N,) not negative; None, or zeros alone, for equal ones.
        seed: Of the vectors looked at and the first centroids.
        iterations: Times that all centroids are moved; fewer if nothing changes any more.
        sample: Vectors that the iterations look at, drawn at random, at least `codes`; None for 64 a code and at
            least 262,144.
        progress: Is given the number of assignments done, and of all; called several times a second.
        device: Where to compute; the result is on the CPU.

    Raises:
        BadInput: For other shapes and types, values that are NaN, Inf or beyond 1e15, and numbers out of range.
    """
    vectors = checked("vectors", vectors)
    weight = checked_weights(weights, len(vectors))
    for name, value, low in (("codes", codes, 1), ("iterations", iterations, 0), ("sample", sample, codes)):
        if value is not None and value < low:
            raise BadInput(f"{name} is {value}; it must be at least {low}")
    if (exact := few_different(vectors, weight, codes)) is not None:
        return exact
    generator = np.random.default_rng(seed)
    rows = np.flatnonzero(weight)
    rows = generator.permutation(rows)[: sample or max(VECTORS_PER_CODE * codes, MIN_SAMPLED_VECTORS)]
    return Lloyd(vectors[torch.from_numpy(rows)], weight[rows], codes, generator, iterations, progress, device).run()


def checked_weights(weights: Tensor | None, count: int) -> np.ndarray:
    """(N,) float64 weights, of which one is positive."""
    if weights is None:
        return np.ones(count)
    expect("weights", weights, (count,))
    weight = weights.detach().cpu().double().numpy()
    if not (np.isfinite(weight) & (weight >= 0)).all():
        row = int(np.flatnonzero(~(np.isfinite(weight) & (weight >= 0)))[0])
        raise BadInput(f"weights: row {row} has the value {weight[row]:g}; weights must be finite and not negative")
    return weight if weight.any() else np.ones(count)


def few_different(vectors: Tensor, weight: np.ndarray, codes: int) -> Tensor | None:
    """(codes, D) the different vectors, the heaviest first; None where more than `codes` of them have a weight."""
    rows, some = np.flatnonzero(weight), 0
    while some < len(rows):
        some = max(2 * codes, 4 * some)
        if len(np.unique(as_bytes(vectors[torch.from_numpy(rows[:some])]))) > codes:
            return None
    if not len(vectors):
        return torch.zeros(codes, vectors.shape[1])
    _, first, which = np.unique(as_bytes(vectors), return_index=True, return_inverse=True)
    heaviest = np.argsort(-np.bincount(which, weight), kind="stable")[:codes]
    chosen = np.concatenate([first[heaviest], np.full(codes - len(heaviest), first[heaviest[0]])])
    return vectors[torch.from_numpy(chosen)]


def as_bytes(vectors: Tensor) -> np.ndarray:
    """(N,) the bytes of each vector as one value; -0 is 0."""
    return (vectors + 0.0).numpy().view(np.dtype((np.void, 4 * vectors.shape[1])))[:, 0]


@dataclass
class Lloyd:
    """One run.

    Attributes:
        vectors: (N, D) more different ones than codes.
        weight: (N,) positive.
        codes: Number of centroids.
        generator: Of the first centroids.
        iterations: At most.
        progress: See `kmeans`.
        device: Where vectors are searched for and added up; all that is done with codes is done on the CPU.
    """

    vectors: Tensor
    weight: np.ndarray
    codes: int
    generator: np.random.Generator
    iterations: int
    progress: Progress | None
    device: torch.device = CPU

    def __post_init__(self) -> None:
        self.there = self.vectors.to(self.device)
        self.weights = torch.from_numpy(self.weight).to(self.device)
        if self.device.type == "cuda":
            self.features, self.of_vectors = itself, self.there
        else:
            some = DistanceBounds.of(self.vectors[:DIRECTION_VECTORS]).fitted(self.vectors, self.vectors[: self.codes])
            self.features, self.of_vectors = some, some(self.vectors)
        self.done, self.all = 0, len(self.vectors) * self.iterations

    def run(self) -> Tensor:
        """(codes, D) centroids."""
        codebook = self.seeds()
        for _ in range(self.iterations):
            before, codebook = codebook, self.improved(codebook)
            if torch.equal(before, codebook):
                break
        self.report(self.all - self.done)
        return codebook

    def report(self, count: int) -> None:
        """So many assignments more are done."""
        self.done += count
        if self.progress is not None and count:
            self.progress(self.done, self.all)

    def seeds(self) -> Tensor:
        """(codes, D) vectors, drawn at even steps of the weight; those heavier than a step once."""
        ends = np.cumsum(self.weight)
        steps = (np.arange(self.codes) + self.generator.random()) * (ends[-1] / self.codes)
        chosen = np.unique(np.searchsorted(ends, steps, side="right").clip(0, len(ends) - 1))
        others = np.setdiff1d(np.arange(len(ends)), chosen)[: self.codes - len(chosen)]
        return self.vectors[torch.from_numpy(np.concatenate([chosen, others]))]

    def improved(self, codebook: Tensor) -> Tensor:
        """(codes, D) each code at the mean of its vectors, after some are merged and others split."""
        search = searching(codebook, self.features, self.device)
        index, distance = self.assigned(search)
        means = Means.of(self.sums(index, self.codes), codebook)
        places = means.places.copy()
        if self.codes > 1:
            halves = self.halves(index, distance, means)
            centres = torch.from_numpy(places.astype(np.float32)).to(self.device)
            own = torch.arange(self.codes, dtype=torch.int32)
            close = search.nearest(centres, self.features(centres), own)[0].cpu().numpy()
            relocate(places, means, halves, close)
        return torch.from_numpy(places.astype(np.float32))

    def assigned(self, search: Search) -> tuple[Tensor, Tensor]:
        """(N,) int32 index of the nearest code, and (N,) float32 squared distance, on the device."""
        found = []
        for rows in search.parts(len(self.there)):
            found.append(search.nearest(self.there[rows], self.of_vectors[rows]))
            self.report(rows.stop - rows.start)
        index, distance = zip(*found, strict=True)
        return torch.cat(index), torch.cat(distance)

    def sums(self, index: Tensor, codes: int) -> np.ndarray:
        """See `sums`."""
        return sums(self.there, self.weights, index, codes)

    def halves(self, index: Tensor, distance: Tensor, means: Means) -> Means:
        """The means of both halves of the vectors of each code, first of one half and then of the other.

        They are halved by their direction from the mean: that of the largest error, and then that from half to half.

        Args:
            index: (N,) the code of each vector.
            distance: (N,) how far it is from it, squared.
            means: Of the codes.
        """
        order = np.argsort(distance.cpu().double().numpy() * self.weight, kind="stable")
        farthest = np.zeros(self.codes, np.int64)
        farthest[index.cpu().numpy()[order]] = order  # the last one stays
        directions = self.vectors.numpy()[farthest] - means.places
        for _ in range(HALVINGS):
            halved = halve(self.there, means.places, directions, index)
            halves = Means.of(self.sums(halved, 2 * self.codes), np.repeat(means.places, 2, 0))
            directions = halves.places[1::2] - halves.places[::2]
        return halves


@dataclass(frozen=True)
class Means:
    """Of the vectors of each code.

    Attributes:
        weight: (K,) sum of their weights.
        places: (K, D) float64 weighted mean; what it was before, where there is none.
    """

    weight: np.ndarray
    places: np.ndarray

    @classmethod
    def of(cls, total: np.ndarray, before: np.ndarray | Tensor) -> Means:
        """From (K, D + 1) sums."""
        weight = total[:, -1]
        mean = total[:, :-1] / np.where(weight > 0, weight, 1)[:, None]
        return cls(weight, np.where(weight[:, None] > 0, mean, np.asarray(before, np.float64)))

    def parting(self, one: np.ndarray, other: np.ndarray) -> np.ndarray:
        """(K,) how much more the sum is when the vectors of two codes, (K,) each, have one mean, not two."""
        together = np.maximum(self.weight[one] + self.weight[other], np.finfo(float).tiny)
        apart = squares(self.places[one] - self.places[other])
        return self.weight[one] / together * self.weight[other] * apart


def relocate(places: np.ndarray, means: Means, halves: Means, close: np.ndarray) -> None:
    """Merge codes and split others in their place, as long as this makes the sum of squares smaller.

    Args:
        places: (K, D) float64 codes, changed.
        means: Of the vectors of each code.
        halves: Of both halves of them.
        close: (K,) another code near each.
    """
    codes = np.arange(len(places))
    cost, gain = means.parting(codes, close), halves.parting(2 * codes, 2 * codes + 1)
    splits = iter(np.argsort(-gain, kind="stable").tolist())
    is_changed = np.zeros(len(places), bool)
    for code in np.argsort(cost, kind="stable").tolist():
        other, is_alive = close[code], means.weight[code] > 0
        if is_changed[code] or (is_alive and is_changed[other]):
            continue
        is_changed[code] = True
        is_changed[other] |= is_alive
        split = next((split for split in splits if not is_changed[split]), None)
        if split is None or gain[split] <= cost[code]:
            return
        if is_alive:
            one, two = means.weight[code], means.weight[other]
            places[other] = (one * means.places[code] + two * means.places[other]) / (one + two)
        places[code], places[split] = halves.places[2 * split], halves.places[2 * split + 1]
        is_changed[split] = True


def squares(rows: np.ndarray) -> np.ndarray:
    """(N,) float64 sums of the squares of each row, in their order."""
    total = np.zeros(len(rows))
    for column in rows.T:
        total += column * column
    return total


def halve(vectors: Tensor, middles: np.ndarray, directions: np.ndarray, index: Tensor) -> Tensor:
    """(N,) int32: twice the code, and one more for vectors ahead of its middle in its direction."""
    if vectors.device.type == "cpu" and module() is not None:
        halved = index.clone()
        kernels().halve(vectors.numpy(), middles, directions, halved.numpy(), torch.get_num_threads())
        return halved
    ahead, code = torch.zeros(len(index), dtype=torch.float64, device=index.device), index.long()
    columns = (torch.from_numpy(np.ascontiguousarray(each.T)).to(index.device) for each in (middles, directions))
    for x, middle, direction in zip(vectors.T, *columns, strict=True):
        ahead += (x - middle[code]) * direction[code]  # two roundings: the bits are those of the CPU
    return 2 * index + (ahead > 0)


def sums(vectors: Tensor, weights: Tensor, index: Tensor, codes: int) -> np.ndarray:
    """(codes, D + 1) float64 weighted sums of the vectors of each code, in their order, and of the weights."""
    if vectors.device.type == "cuda":
        return gpu.sums(vectors, weights, index, codes).cpu().numpy()
    rows, weight, code = vectors.numpy(), weights.numpy(), index.numpy()
    if module() is not None:
        total = np.zeros((codes, rows.shape[1] + 1))
        kernels().sum_by_code(rows, weight, code, total, torch.get_num_threads())
        return total
    columns = [weight, *(weight * column for column in rows.T.astype(np.float64))]
    return np.stack([np.bincount(code, column, codes) for column in columns[1:] + columns[:1]], 1)
