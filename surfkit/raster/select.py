"""Which rasterizer draws: the device decides, a recipe does not."""

from __future__ import annotations

import warnings
from typing import Literal

import torch

from surfkit import native
from surfkit.core.check import BadInput
from surfkit.raster.api import Rasterizer
from surfkit.raster.native import NativeRasterizer

Device = Literal["auto", "cpu", "cuda"]


def select(device: Device = "auto") -> tuple[Rasterizer, str]:
    """A rasterizer for the device, and its name for run.json, such as "cpu avx512"."""
    if device == "cuda":
        raise BadInput("--device cuda: the CUDA rasterizer is not part of this version; use --device cpu")
    if native.module() is not None:
        return NativeRasterizer(), f"cpu {native.module().kernels_in_use()}"
    from surfkit.raster.reference import Reference

    warnings.warn(
        "surfkit was installed without its compiled rasterizer (no C++ compiler was found): the reference in torch "
        "draws instead, about a hundred times slower; install GCC or Clang, then surfkit again",
        stacklevel=2,
    )
    return Reference(), f"cpu reference ({torch.__version__})"
