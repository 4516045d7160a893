"""Arguments of a launch, checked against what the kernel declares and laid out as the CUDA driver takes them."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from surfkit.raster.nvrtc.cuda_source import SCALAR_TYPES, CudaSource, Kernel, Parameter

Size = int | Sequence[int]
"""Of a grid or block: x, or (x, y), or (x, y, z)."""


@dataclass(frozen=True)
class Elements:
    """What a tensor must be to be a `Buffer` of some type.

    Attributes:
        dtypes: Of the tensor; any if empty.
        size: Bytes of an element, which may be several numbers of the tensor.
        align: Bytes of which the address is a multiple.
    """

    dtypes: tuple[torch.dtype, ...]
    size: int
    align: int


def _numbers(dtypes: Sequence[torch.dtype], count: int = 1, align: int | None = None) -> Elements:
    size = count * dtypes[0].itemsize
    return Elements(tuple(dtypes), size, align or size)


ELEMENTS: dict[str, Elements] = {
    "float": _numbers([torch.float32]),
    "double": _numbers([torch.float64]),
    "int": _numbers([torch.int32]),
    "unsigned": _numbers([torch.int32, torch.uint32]),
    "long long": _numbers([torch.int64]),
    "unsigned long long": _numbers([torch.int64, torch.uint64]),
    "short": _numbers([torch.int16]),
    "unsigned short": _numbers([torch.int16, torch.uint16]),
    "unsigned char": _numbers([torch.uint8]),
    "bool": _numbers([torch.bool]),
    "float2": _numbers([torch.float32], 2),
    "float3": _numbers([torch.float32], 3, 4),
    "float4": _numbers([torch.float32], 4),
    "int2": _numbers([torch.int32], 2),
    "int3": _numbers([torch.int32], 3, 4),
    "int4": _numbers([torch.int32], 4),
    "uint2": _numbers([torch.int32, torch.uint32], 2),
    "uint4": _numbers([torch.int32, torch.uint32], 4),
}


class BufferArgument(ctypes.Structure):
    """What `Buffer` is in device memory."""

    _fields_ = (("data", ctypes.c_void_p), ("size", ctypes.c_longlong))


class Signature:
    """What the arguments of a kernel are and how they are laid out.

    Raises:
        TypeError: A parameter is of a type that cannot be passed.
    """

    def __init__(self, source: CudaSource, kernel: Kernel, device: torch.device) -> None:
        self.kernel = kernel
        self._packers = [_packer(source, kernel, parameter, device) for parameter in kernel.parameters]

    def pack(self, arguments: Sequence[Any]) -> list[Any]:
        """A ctypes value for each parameter.

        Raises:
            TypeError: Their number, or an argument's type, device, layout or size is not what the kernel declares.
        """
        if len(arguments) != len(self._packers):
            name, count = self.kernel.name, len(self._packers)
            raise TypeError(f"kernel {name}: takes {count} arguments, got {len(arguments)}")
        return [pack(value) for pack, value in zip(self._packers, arguments, strict=True)]

    def sizes(self, grid: Size, block: Size) -> tuple[tuple[int, int, int], tuple[int, int, int]]:
        """Those of grid and block with all three numbers.

        Raises:
            TypeError: CUDA or the kernel does not allow them.
        """
        grid, block = _three(grid), _three(block)
        most = self.kernel.threads or 1024
        if not 0 < block[0] * block[1] * block[2] <= most or min(block) < 1:
            raise TypeError(f"kernel {self.kernel.name}: blocks of {block}, allowed are up to {most} threads")
        if min(grid) < 0 or grid[0] >= 2**31 or max(grid[1:]) >= 2**16:
            raise TypeError(f"kernel {self.kernel.name}: a grid of {grid}, allowed are up to (2^31 - 1, 65535, 65535)")
        return grid, block


def signatures(source: CudaSource, device: torch.device) -> dict[str, Signature]:
    """That of each kernel, by its name."""
    return {name: Signature(source, kernel, device) for name, kernel in source.kernels.items()}


def _three(size: Size) -> tuple[int, int, int]:
    x, y, z, *_ = *((size,) if isinstance(size, int) else size), 1, 1
    return x, y, z


def _packer(source: CudaSource, kernel: Kernel, parameter: Parameter, device: torch.device) -> Callable[[Any], Any]:
    where = f"kernel {kernel.name}, {parameter.name}"
    structure = source.structures.get(parameter.type)
    if parameter.is_buffer:
        if structure:
            elements = Elements((), ctypes.sizeof(structure), ctypes.alignment(structure))
        elif parameter.type in ELEMENTS:
            elements = ELEMENTS[parameter.type]
        else:
            known = f"{', '.join(ELEMENTS)} and structures"
            raise TypeError(f"{where}: {parameter.type} is no type of elements; known are {known}")
        return _buffer_packer(where, elements, device)
    if structure:
        return _structure_packer(where, structure)
    if parameter.type not in SCALAR_TYPES:
        raise TypeError(
            f"{where}: {parameter.type} is no type of values; known are {', '.join(SCALAR_TYPES)} and structures"
        )
    return _number_packer(where, parameter.type)


def _buffer_packer(where: str, elements: Elements, device: torch.device) -> Callable[[Any], BufferArgument]:
    dtypes, size, align = elements.dtypes, elements.size, elements.align

    def pack(value: Any) -> BufferArgument:
        if not isinstance(value, Tensor):
            raise TypeError(f"{where}: wants a tensor, got {type(value).__name__}")
        if value.device != device:
            raise TypeError(f"{where}: wants a tensor on {device}, got one on {value.device}")
        data, count = value.data_ptr(), value.nbytes
        fits = count % size == 0 and data % align == 0 and value.is_contiguous()
        if not fits or (dtypes and value.dtype not in dtypes):
            kinds = " or ".join(map(str, dtypes)) or "any numbers"
            raise TypeError(
                f"{where}: wants a contiguous tensor of {kinds}, elements of {size} bytes aligned to {align}, got "
                f"{value.dtype} of shape {tuple(value.shape)}, strides {value.stride()}"
            )
        return BufferArgument(data, count // size)

    return pack


def _structure_packer(where: str, structure: type[ctypes.Structure]) -> Callable[[Any], ctypes.Structure]:
    def pack(value: Any) -> ctypes.Structure:
        if not isinstance(value, structure):
            raise TypeError(f"{where}: wants a {structure.__name__}, got {type(value).__name__}")
        return value

    return pack


def _number_packer(where: str, name: str) -> Callable[[Any], Any]:
    number = SCALAR_TYPES[name]
    kinds: dict[Any, Any] = {ctypes.c_bool: bool, ctypes.c_float: (int, float), ctypes.c_double: (int, float)}
    wanted = kinds.get(number, int)

    def pack(value: Any) -> Any:
        if not isinstance(value, wanted) or (isinstance(value, bool) and wanted is not bool):
            raise TypeError(f"{where}: wants a number of type {name}, got {value!r}")
        packed = number(value)
        if wanted is int and packed.value != value:
            raise TypeError(f"{where}: {value} is out of the range of {name}")
        return packed

    return pack
