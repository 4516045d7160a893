"""The search of the nearest code, and the sums of k-means, on a GPU: the bits of the CPU.

Every vector is compared with every code in float32, through shared memory: 400,000 vectors of 45 numbers and 8,192
codes are 3e11 operations, some 10 ms. `torch.mm` and `argmin` would take half the operations, but write and read
13 GB of products, as slow on the fastest memory and slower on any other, whose rounding errors also grow with the
distance from the origin. Those of differences are a share of the distance; only where another code is within them, a
warp takes the distances to all codes in float64.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import torch
from torch import Tensor

from surfkit.raster.nvrtc.cuda_source import CudaSource
from surfkit.raster.nvrtc.modules import Kernels, kernels

CODES_SOURCE = CudaSource(Path(__file__).with_name("codes.cu"), is_exact=True)
TILE_VECTORS = 128
"""Vectors of a block of `approach`."""
VECTORS_PER_LAUNCH = 1 << 18
"""Vectors in one call, at most: below 0.1 s with 65,536 codes."""


class GpuSearch:
    """See `compress.nearest.Search`; makes no use of features."""

    def __init__(self, codebook: Tensor, device: torch.device, on: Kernels | None = None) -> None:
        self.codebook, self.on = codebook.to(device), on or kernels(CODES_SOURCE, device)
        self.none = torch.empty(0, dtype=torch.int32, device=device)
        terms = codebook.shape[1] + 8
        self.bounds = 1 + 2 * terms * 2.0**-24, terms * 2.0**-125  # of rounding errors, as in cpu/nearest.cpp

    def parts(self, rows: int) -> Iterator[slice]:
        """See `Search.parts`."""
        return (slice(at, min(rows, at + VECTORS_PER_LAUNCH)) for at in range(0, rows, VECTORS_PER_LAUNCH))

    def nearest(self, vectors: Tensor, features: Tensor, without: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """See `Search.nearest`; vectors and results are on the GPU."""
        left_out = self.none if without is None else without.to(vectors.device)
        found, index = torch.empty(2, len(vectors), dtype=torch.int32, device=vectors.device).unbind()
        distance = torch.empty(len(vectors), device=vectors.device)
        given = vectors, self.codebook, vectors.shape[1], len(self.codebook), left_out
        self.on.launch("approach", -(-len(vectors) // TILE_VECTORS), 256, *given, *self.bounds, found)
        self.on.launch("settle", -(-len(vectors) // 8), 256, *given, found, index, distance)
        return index, distance


def sums(vectors: Tensor, weights: Tensor, index: Tensor, codes: int, on: Kernels | None = None) -> Tensor:
    """(codes, D + 1) float64 weighted sums of the vectors of each code, in their order, and of the weights.

    Args:
        vectors: (N, D) float32.
        weights: (N,) float64.
        index: (N,) int32, the code of each vector.
        codes: Their number.
        on: The kernels; by default those for the device of the vectors.
    """
    ordered, order = index.sort(stable=True)
    offsets = torch.searchsorted(ordered, torch.arange(codes + 1, dtype=torch.int32, device=index.device))
    total = torch.empty(codes, vectors.shape[1] + 1, dtype=torch.float64, device=index.device)
    on = on or kernels(CODES_SOURCE, vectors.device)
    on.launch("sum_by_code", codes, 64, vectors, weights, order, offsets, vectors.shape[1], total)
    return total
