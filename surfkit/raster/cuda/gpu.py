"""The rasterizer of NVIDIA GPUs: the kernels of this folder, compiled for the one that torch uses."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import ClassVar

import torch

from surfkit.core.check import BadInput
from surfkit.raster.cuda.rasterizer import TileRasterizer, source
from surfkit.raster.nvrtc.cuda_source import CudaSource
from surfkit.raster.nvrtc.driver import driver
from surfkit.raster.nvrtc.modules import Kernels, kernels
from surfkit.raster.nvrtc.nvrtc import nvrtc


@dataclass(frozen=True)
class CudaRasterizer(TileRasterizer):
    """Draws on an NVIDIA GPU, by kernels that are compiled for it at first use; sums in a fixed order."""

    device: ClassVar[str] = "cuda"
    rank: ClassVar[int] = 10

    def missing(self) -> str | None:
        """See `Rasterizer.missing`."""
        if torch.version.cuda is None:
            return (
                "this build of torch is one without CUDA; install another (pytorch.org tells how), or use --device cpu"
            )
        if not torch.cuda.is_available():
            return "torch finds no NVIDIA GPU or driver here (nvidia-smi tells more); use --device cpu"
        try:
            driver(self.where())
            nvrtc().architecture(torch.cuda.get_device_capability(self.where()))
        except BadInput as error:
            return str(error)
        return _lacks_architecture(self.where())

    def title(self) -> str:
        """See `Rasterizer.title`."""
        return f"{self.where()} {torch.cuda.get_device_name(self.where())}"

    def where(self) -> torch.device:
        """See `Rasterizer.where`; the GPU that torch uses now."""
        return torch.device("cuda", torch.cuda.current_device())

    def program(self, name: str, **defines: int) -> Kernels:
        """See `TileRasterizer.program`."""
        return kernels(_source(name, tuple(sorted(defines.items()))), self.where())


def _lacks_architecture(device: torch.device) -> str | None:
    """What to do where this build of torch has no kernels that run on a GPU."""
    major, minor = torch.cuda.get_device_capability(device)
    known = [name.partition("_")[::2] for name in torch.cuda.get_arch_list()]
    built = [(kind, int("".join(filter(str.isdigit, number)))) for kind, number in known]
    own = major * 10 + minor
    if any(n // 10 == major and n <= own if kind == "sm" else n <= own for kind, n in built):
        return None
    names = ", ".join(torch.cuda.get_arch_list())
    return (
        f"this build of torch has no kernels for {torch.cuda.get_device_name(device)} (sm_{own}; it has {names}); "
        "install another build (pytorch.org tells which), or use --device cpu"
    )


@cache
def _source(name: str, defines: tuple[tuple[str, int], ...]) -> CudaSource:
    """One source for each set of defines, so that its kernels are loaded once."""
    return source(name, **dict(defines))
