"""Kernels on the emulator, and on a GPU where there is one; what they do not write is NaN."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.raster.nvrtc.cuda_source import CudaSource
from surfkit.raster.nvrtc.emulated import Emulated, compiler
from surfkit.raster.nvrtc.modules import Kernels, kernels


@pytest.fixture(autouse=True, scope="session")
def has_compiler():
    try:
        compiler()
    except BadInput as error:
        pytest.skip(str(error))


@pytest.fixture(autouse=True)
def unwritten_is_nan():
    """`torch.empty` fills its tensors, so that a value that no kernel wrote is seen."""
    before = torch.are_deterministic_algorithms_enabled()
    torch.use_deterministic_algorithms(True, warn_only=True)
    yield
    torch.use_deterministic_algorithms(before)


class Anywhere:
    """Kernels that take tensors of the CPU, wherever they run."""

    def __init__(self, on: Kernels) -> None:
        self.on = on

    def launch(self, name: str, grid: Any, block: Any, *arguments: Any) -> None:
        moved = [value.to(self.on.device) if isinstance(value, Tensor) else value for value in arguments]
        self.on.launch(name, grid, block, *moved)
        for value, result in zip(arguments, moved, strict=True):
            if isinstance(value, Tensor) and value is not result:
                value.copy_(result)


@pytest.fixture(params=["emulated", "permuted", pytest.param("cuda", marks=pytest.mark.cuda)])
def load(request) -> Callable[[CudaSource], Kernels]:
    """Gives the kernels of a source, whose `device` the tensors must be on."""
    if request.param != "cuda":
        return lambda source: Emulated(source, seed=5 * (request.param == "permuted"))
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    return lambda source: kernels(source, torch.device("cuda"))
