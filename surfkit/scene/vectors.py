"""Vectors of pictures and points."""

from __future__ import annotations

from torch import Tensor


def unit(vectors: Tensor, dim: int = 0) -> Tensor:
    """Vectors of length 1, of any shape; 0 stays 0.

    On the CPU, torch's norm over the first axis of a picture takes 40 times as long as the sum of squares.
    """
    length = vectors.square().sum(dim, keepdim=True).sqrt()
    return vectors / length.clamp_min(1e-20)
