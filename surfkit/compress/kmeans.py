"""Vector quantisation: weighted k-means.

Lloyd's iterations from seeds that are drawn in a few rounds, each in proportion to the weighted squared distance to the
seeds before (k-means||: Bahmani et al. 2012). Assignments are exact and sums are float64 in the order of the vectors, so
a seed gives the same bits on any number of threads, with any instruction set, and without a compiler.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from surfkit.compress.nearest import Features, checked, nearest, searching
from surfkit.core.check import BadInput, expect
from surfkit.native import module

__all__ = ["kmeans", "nearest"]

ROUNDS = 4
"""In which the seeds are drawn."""
EACH = 64
"""Vectors for each code that the iterations look at, unless told otherwise."""
FEWEST = 1 << 18
"""Vectors that the iterations look at in any case, unless told otherwise."""
SURVEYED = 1 << 16
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
) -> Tensor:
    """(codes, D) float32 centroids that make the weighted sum of squared distances to the nearest one small.

    Where no more than `codes` different vectors have a weight, the result is these, then others, then copies of the
    first. A code without vectors is moved to the vector of the largest weighted error. Memory is of the order of the
    arguments. No number of threads and no instruction set changes a bit, nor does a missing compiler, without which it
    takes some fifty times longer.

    Args:
        vectors: (N, D) float32.
        codes: Number of centroids, at least 1.
        weights: (N,) not negative; None, or zeros alone, for equal ones.
        seed: Of the vectors looked at and the first centroids.
        iterations: Times that all centroids are moved to the mean of their vectors; fewer if nothing changes any more.
        sample: Vectors that the iterations look at, drawn at random, at least `codes`; None for 64 a code and at
            least 262,144.
        progress: Is given the number of assignments done, and of all; called several times a second.

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
    rows = generator.permutation(rows)[: sample or max(EACH * codes, FEWEST)]
    return Lloyd(vectors[torch.from_numpy(rows)], weight[rows], codes, generator, iterations, progress).run()


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
    """

    vectors: Tensor
    weight: np.ndarray
    codes: int
    generator: np.random.Generator
    iterations: int
    progress: Progress | None

    def __post_init__(self) -> None:
        some = Features.of(self.vectors[:SURVEYED]).fitted(self.vectors, self.vectors[: self.codes])
        self.features, self.of_vectors = some, some(self.vectors)
        self.done, self.all = 0, len(self.vectors) * (ROUNDS - 1 + self.iterations)

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

    def nearest(self, codebook: Tensor) -> tuple[np.ndarray, np.ndarray]:
        """(N,) index of the nearest code and (N,) float64 squared distance."""
        search = searching(codebook, self.features)
        index, distance = np.empty(len(self.vectors), np.int32), np.empty(len(self.vectors))
        for rows in search.parts(len(self.vectors)):
            index[rows], distance[rows] = search.nearest(self.vectors[rows], self.of_vectors[rows])
            self.report(rows.stop - rows.start)
        return index, distance

    def seeds(self) -> Tensor:
        """(codes, D) vectors, far from one another."""
        chosen, error = np.empty(0, np.int64), np.full(len(self.weight), np.inf)
        worth = self.weight
        for left in range(ROUNDS, 0, -1):
            fresh = drawn(worth, (self.codes - len(chosen)) // left, self.generator)
            chosen = np.concatenate([chosen, fresh])
            if left > 1 and len(fresh):
                error = np.minimum(error, self.nearest(self.vectors[torch.from_numpy(fresh)])[1])
                worth = self.weight * error
        others = np.setdiff1d(np.arange(len(self.weight)), chosen)[: self.codes - len(chosen)]
        return self.vectors[torch.from_numpy(np.concatenate([chosen, others]))]

    def improved(self, codebook: Tensor) -> Tensor:
        """Each code at the mean of its vectors, or at a vector far from all codes where it has none."""
        index, error = self.nearest(codebook)
        total = sums(self.vectors, self.weight, index, self.codes)
        dead = np.flatnonzero(total[:, -1] == 0)
        total[dead, -1] = 1
        moved = torch.from_numpy((total[:, :-1] / total[:, -1:]).astype(np.float32))
        if len(dead):
            worst = np.argsort(-self.weight * error, kind="stable")[: len(dead)]
            moved[torch.from_numpy(dead)] = self.vectors[torch.from_numpy(worst)]
        return moved


def drawn(worth: np.ndarray, count: int, generator: np.random.Generator) -> np.ndarray:
    """Indices of up to `count` items, drawn in proportion to their worth at even steps; none twice."""
    ends = np.cumsum(worth)
    if not count or not ends[-1]:
        return np.empty(0, np.int64)
    steps = (np.arange(count) + generator.random()) * (ends[-1] / count)
    return np.unique(np.searchsorted(ends, steps, side="right").clip(0, len(ends) - 1))


def sums(vectors: Tensor, weight: np.ndarray, index: np.ndarray, codes: int) -> np.ndarray:
    """(codes, D + 1) float64 weighted sums of the vectors of each code, in their order, and of the weights."""
    if module() is not None:
        total = np.zeros((codes, vectors.shape[1] + 1))
        module().sum_by_code(vectors.numpy(), weight, index, total, torch.get_num_threads())
        return total
    columns = [weight, *(weight * column for column in vectors.numpy().T.astype(np.float64))]
    return np.stack([np.bincount(index, column, codes) for column in columns[1:] + columns[:1]], 1)
