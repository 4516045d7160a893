"""Loading and launching kernels, on whichever device the tensors are."""

from __future__ import annotations

from functools import cache
from typing import Any, Protocol

import torch

from surfkit.raster.nvrtc.arguments import Size, signatures
from surfkit.raster.nvrtc.cuda_source import CudaSource
from surfkit.raster.nvrtc.driver import Driver, driver
from surfkit.raster.nvrtc.emulated import Emulated
from surfkit.raster.nvrtc.nvrtc import image, nvrtc


class Kernels(Protocol):
    """The kernels of a source, ready to run on the tensors of a device."""

    device: torch.device

    def launch(self, name: str, grid: Size, block: Size, *arguments: Any) -> None:
        """Run a kernel; on a GPU it is queued on torch's current stream, and nothing waits for it.

        Args:
            name: Of the kernel.
            grid: Blocks; where one of the numbers is 0 nothing is done.
            block: Threads of a block.
            arguments: As the kernel declares them: contiguous tensors of the device for `Buffer`, numbers, structures.

        Raises:
            TypeError: An argument or size is not what the kernel declares.
        """


class Compiled:
    """Kernels on a GPU, compiled for it by NVRTC at first use, then taken from the user's cache."""

    def __init__(self, source: CudaSource, device: torch.device, backend: Driver | None = None) -> None:
        self.source, self.device = source, device
        self._driver = backend or driver(device)
        architecture = nvrtc().architecture(self._driver.capability)
        module = self._driver.load(image(source, architecture, self._driver.version))
        self._signatures = signatures(source, device)
        self._functions = {name: self._driver.function(module, name) for name in source.kernels}

    def launch(self, name: str, grid: Size, block: Size, *arguments: Any) -> None:
        """See `Kernels`."""
        signature = self._signatures[name]
        grid, block = signature.sizes(grid, block)
        packed = signature.pack(arguments)
        if 0 not in grid:
            self._driver.launch(self._functions[name], grid, block, packed)


def kernels(source: CudaSource, device: torch.device) -> Kernels:
    """The kernels of a source for a device, loaded once per process: a GPU's, or the emulator's for the CPU.

    Raises:
        BadInput: The machine lacks a compiler, or a driver that fits; says what to do.
    """
    if device.type == "cuda" and device.index is None:
        device = torch.device("cuda", torch.cuda.current_device())
    return _loaded(source, device)


@cache
def _loaded(source: CudaSource, device: torch.device) -> Kernels:
    return Emulated(source) if device.type == "cpu" else Compiled(source, device)
