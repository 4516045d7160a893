"""The nearest code of each vector, exactly and without a matrix of all distances.

The squared distance is defined as the float64 sum of the squared differences in the order of the dimensions; among
equal ones the lowest index counts. The compiled search and the one in torch both rule codes out within bounds of their
rounding errors and then take this sum, and so does a GPU: all give the same bits, on any number of threads.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from surfkit.compress.cuda.codes import GpuSearch
from surfkit.core.check import BadInput, expect
from surfkit.raster.native import kernels, module

CPU = torch.device("cpu")
MAX_VECTOR_VALUE = 1e15
"""Greatest absolute value in a vector: its square must be far from the end of float32."""
MULTIPLICATIONS_PER_CALL = 1 << 31
"""Multiplications in one call of the compiled search, for each thread: well below a second, so that Ctrl-C works."""
VECTORS_PER_CALL = 1 << 15
"""Vectors in one call of the compiled search, at most."""
MAX_TORCH_DISTANCES = 1 << 21
"""Distances that the search in torch holds at once."""
CODES_PER_BLOCK = 16
"""Codes that the compiled search rules out together: kBlock of cpu/nearest.h."""
PROBE_VECTORS = 128
"""Vectors on which the number of features is chosen."""
FEATURES = (4, 6, 8, 10, 12, 16, 24, 32)
"""Numbers of principal components among which it is chosen, besides all of them."""


def nearest(vectors: Tensor, codebook: Tensor, device: torch.device = CPU) -> tuple[Tensor, Tensor]:
    """(N,) int32 index of the nearest code of each vector, and (N,) float32 squared distance to it.

    The distance is the float64 sum of the squared differences in the order of the dimensions, rounded; among equal ones
    the lowest index is taken. Memory is of the order of the arguments. No number of threads and no instruction set
    changes a bit, nor does a GPU, or a missing compiler, without which it takes some fifty times longer.

    Args:
        vectors: (N, D) float32.
        codebook: (K, D) float32; K may be 0 only where N is.
        device: Where to search; results are on the CPU.

    Raises:
        BadInput: For another shape or type, and for values that are NaN, Inf or beyond 1e15.
    """
    vectors, codebook = checked("vectors", vectors), checked("codebook", codebook)
    expect("codebook", codebook, ("K", "D"), expect("vectors", vectors, ("N", "D")))
    if len(vectors) and not len(codebook):
        raise BadInput(f"codebook: it has no codes, and there are {len(vectors)} vectors; give at least one code")
    index, distance = torch.zeros(len(vectors), dtype=torch.int32), torch.zeros(len(vectors))
    if len(vectors):
        features = itself if device.type == "cuda" else DistanceBounds.of(codebook).fitted(vectors, codebook)
        search = searching(codebook, features, device)
        for rows in search.parts(len(vectors)):
            some = vectors[rows].to(device)
            index[rows], distance[rows] = (found.cpu() for found in search.nearest(some, features(some)))
    return index, distance


def checked(name: str, vectors: Tensor) -> Tensor:
    """The matrix (N, D) on the CPU, contiguous.

    Raises:
        BadInput: Unless it is a float32 matrix of finite values up to 1e15.
    """
    expect(name, vectors, ("N", "D"))
    if vectors.dtype != torch.float32:
        raise BadInput(f"{name}: expected float32, got {str(vectors.dtype).removeprefix('torch.')}; convert it first")
    if vectors.shape[1] == 0:
        raise BadInput(f"{name}: expected at least one column, got {tuple(vectors.shape)}")
    vectors = vectors.detach().cpu().contiguous()
    if (
        len(vectors) and not max(-float(vectors.min()), float(vectors.max())) <= MAX_VECTOR_VALUE
    ):  # not so for NaN either
        row = int((~(vectors.abs() <= MAX_VECTOR_VALUE)).any(1).nonzero()[0])
        value = next(value for value in vectors[row].tolist() if not abs(value) <= MAX_VECTOR_VALUE)
        raise BadInput(
            f"{name}: row {row} has the value {value:g}; values must be finite and at most {MAX_VECTOR_VALUE:g}"
        )
    return vectors


@dataclass(frozen=True)
class DistanceBounds:
    """Fewer numbers than dimensions, whose distance is at most that of the vectors: they rule codes out.

    Attributes:
        mean: (D,) float64, subtracted; float32 numbers, so that the difference is nearly exact.
        axes: (D, D) float64, principal directions in columns, orthogonal, the greatest first.
        used: Leading components that are features, and one more is the norm of the others; or D, all of them.
    """

    mean: Tensor
    axes: Tensor
    used: int

    @classmethod
    def of(cls, vectors: Tensor) -> DistanceBounds:
        """All principal components of (N, D) vectors."""
        mean = vectors.double().mean(0).float().double()
        centred = vectors.double() - mean
        return cls(mean, torch.linalg.eigh(centred.T @ centred).eigenvectors.flip(1), vectors.shape[1])

    def __call__(self, vectors: Tensor) -> Tensor:
        """(N, F) float32 features of (N, D) vectors."""
        return torch.cat([self._reduced(self._turned(part)).float() for part in vectors.split(VECTORS_PER_CALL)])

    def _turned(self, vectors: Tensor) -> Tensor:
        return (vectors.double() - self.mean) @ self.axes

    def _reduced(self, turned: Tensor) -> Tensor:
        if self.used == turned.shape[1]:
            return turned
        return torch.cat([turned[:, : self.used], turned[:, self.used :].norm(dim=1, keepdim=True)], 1)

    def fitted(self, vectors: Tensor, codebook: Tensor) -> DistanceBounds:
        """With as many components as make the search of (N, D) vectors in (codes, D) fastest.

        With few, distances to many codes must be computed.
        """
        dimensions, blocks = codebook.shape[1], len(codebook) // CODES_PER_BLOCK
        some = vectors[:: max(1, len(vectors) // min(PROBE_VECTORS, max(8, MAX_TORCH_DISTANCES // len(codebook))))]
        here, there = self._turned(some), self._turned(codebook[self.order(codebook)[: blocks * CODES_PER_BLOCK]])
        fastest, least = dimensions, blocks * (dimensions + 3.0)
        nearest = torch.cdist(here, there).amin(1, keepdim=True) * (1 + 1e-6) if blocks else None
        for used in FEATURES:
            if used >= dimensions - 2 or nearest is None:
                break
            few = replace(self, used=used)
            bound = (
                torch.cdist(few._reduced(here), few._reduced(there)).view(len(some), blocks, CODES_PER_BLOCK).amin(2)
            )
            hits = float((bound <= nearest).sum() / len(some))
            cost = blocks * (used + 4) + hits * (2.5 * dimensions + 40)  # in vector instructions, about
            if cost < least:
                fastest, least = used, cost
        return replace(self, used=fastest)

    def order(self, codebook: Tensor) -> Tensor:
        """(K,) int64: codes such that alike ones follow one another: in slices along three axes."""
        turned = ((codebook.double() - self.mean) @ self.axes[:, :3]).numpy()
        order = np.argsort(turned[:, 0], kind="stable")
        slices = max(1, round((len(order) / CODES_PER_BLOCK) ** (1 / 3)))
        for axis in range(1, turned.shape[1]):
            cell = np.arange(len(order)) // -(-len(order) // slices**axis)
            order = order[np.lexsort((turned[order, axis], cell))]
        return torch.from_numpy(order)


def itself(vectors: Tensor) -> Tensor:
    """(N, D) in place of features, for searches that have no use for them."""
    return vectors


class Search(Protocol):
    """The codes of one codebook, prepared to be searched."""

    def parts(self, rows: int) -> Iterator[slice]:
        """Slices of so many vectors, each for one call that takes a fraction of a second."""

    def nearest(self, vectors: Tensor, features: Tensor, without: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """As `nearest` of the module, for (N, D) vectors whose (N, F) features are known.

        `without` is the (N,) int32 index of a code that does not count for that vector; there must be another.
        """


class NativeSearch(Search):
    """Compiled; runs on `torch.get_num_threads()` threads."""

    def __init__(self, codebook: Tensor, features: DistanceBounds) -> None:
        self.work = len(codebook) * (features.used + 4)
        arrays = codebook, features(codebook), features.order(codebook)
        self.codes = kernels().Codebook(*(array.numpy() for array in arrays))

    def parts(self, rows: int) -> Iterator[slice]:
        threads = torch.get_num_threads()
        size = min(VECTORS_PER_CALL, max(256 * threads, MULTIPLICATIONS_PER_CALL * threads // self.work))
        return (slice(at, min(rows, at + size)) for at in range(0, rows, size))

    def nearest(self, vectors: Tensor, features: Tensor, without: Tensor | None = None) -> tuple[Tensor, Tensor]:
        index, distance = torch.empty(len(vectors), dtype=torch.int32), torch.empty(len(vectors))
        given = vectors, features, without, index, distance
        arrays = (None if array is None else array.numpy() for array in given)
        self.codes.nearest(*arrays, kernels().kernels_in_use(), torch.get_num_threads())
        return index, distance


class TorchSearch(Search):
    """In torch, where surfkit was installed without a compiler; makes no use of features."""

    def __init__(self, codebook: Tensor) -> None:
        self.codebook = codebook
        self.mean = codebook.double().mean(0).float().double()
        self.centred = codebook.double() - self.mean
        self.half = self.centred.square().sum(1) / 2
        self.reach = float(self.half.max().mul(2).sqrt())

    def parts(self, rows: int) -> Iterator[slice]:
        size = max(1, MAX_TORCH_DISTANCES // len(self.codebook))
        return (slice(at, min(rows, at + size)) for at in range(0, rows, size))

    def nearest(self, vectors: Tensor, features: Tensor, without: Tensor | None = None) -> tuple[Tensor, Tensor]:
        centred = vectors.double() - self.mean
        score = self.half - centred @ self.centred.T  # half the squared distance, less that to the mean
        if without is not None:
            score[torch.arange(len(score)), without.long()] = torch.inf
        error = (vectors.shape[1] + 16) * 2.0**-53 * (centred.norm(dim=1) + self.reach).square() + 1e-300
        row, code = (score <= (score.amin(1) + 2 * error)[:, None]).numpy().nonzero()
        exact = np.zeros(len(row))
        for x, c in zip(vectors.numpy().T, self.codebook.numpy().T, strict=True):
            off = x[row].astype(np.float64) - c[code]
            exact += off * off
        order = np.lexsort((code, exact, row))
        first = order[np.searchsorted(row[order], np.arange(len(vectors)))]
        return torch.from_numpy(code[first].astype(np.int32)), torch.from_numpy(exact[first].astype(np.float32))


def searching(codebook: Tensor, features: Callable[[Tensor], Tensor], device: torch.device = CPU) -> Search:
    """The codebook, (codes, D), on a device: for a GPU, or compiled if surfkit is."""
    if device.type == "cuda":
        return GpuSearch(codebook, device)
    if module() is None:
        return TorchSearch(codebook)
    assert isinstance(features, DistanceBounds), "a search on the CPU is given the features of its codes"
    return NativeSearch(codebook, features)
