"""Kernels on the CPU, for tests without a GPU: compiled by a C++ compiler with emulator/emulator.h in front."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from functools import cache
from hashlib import sha256
from pathlib import Path
from threading import Lock
from typing import Any

import torch

from surfkit.core.caches import cache_root
from surfkit.core.check import BadInput
from surfkit.raster.nvrtc.arguments import BufferArgument, Size, signatures
from surfkit.raster.nvrtc.cuda_source import CUDA_FOLDER, CudaSource, Kernel

FLAGS = ("-std=c++17", "-O1", "-fPIC", "-shared", "-fvisibility=hidden", "-ffp-contract=off", "-w")
"""Hidden, because libraries of several sources, each with its own machine, are loaded into one process."""

LOCK = Lock()
"""Held while a library runs a kernel, as it has one machine."""


class Stacks(ctypes.Structure):
    """`Stacks` of emulator/machine.h."""

    _fields_ = (("memory", ctypes.c_void_p), ("guarded", ctypes.c_int))


STACKS = Stacks()
"""Of the threads of the kernel that runs, in whichever library."""


class KernelError(RuntimeError):
    """A kernel did what it must not; says which thread, where, and what."""


class LaunchStats(ctypes.Structure):
    """What a launch did, as far as memory and meetings go: from it follows what it costs a GPU at least.

    Attributes:
        global_bytes: Read, written and changed atomically in global memory, as the threads asked for it: caches and the
            joining of a warp's accesses make it less.
        shared_bytes: The same of shared memory.
        collectives: Shuffles, votes and `__syncwarp`, once for each warp.
        barriers: Once for each block.
        warps: That ran.
    """

    _fields_ = (
        ("global_bytes", ctypes.c_longlong * 3),
        ("shared_bytes", ctypes.c_longlong * 3),
        ("collectives", ctypes.c_longlong),
        ("barriers", ctypes.c_longlong),
        ("warps", ctypes.c_longlong),
    )


class Emulated:
    """Runs the kernels of a source on tensors of the CPU, thread by thread, and checks what they do.

    Attributes:
        seed: Permutes the order of blocks and of threads; 0 is their natural order.
        device: That the tensors say they are on; another than the CPU is `testing.simulated_gpu`'s.
        work: What the last launch did.
    """

    def __init__(
        self,
        source: CudaSource,
        seed: int = 0,
        flags: Sequence[str] = (),
        device: torch.device = torch.device("cpu"),  # noqa: B008 (immutable)
    ) -> None:
        self.source, self.seed, self.device, self.work = source, seed, device, LaunchStats()
        self._signatures = signatures(source, self.device)
        self._library = _library(
            _with_tail(source), source.path.stem, (*FLAGS, "-DEMULATED", f"-I{CUDA_FOLDER}", *flags)
        )
        for kernel in source.kernels.values():
            self._check_structures(kernel)

    def launch(self, name: str, grid: Size, block: Size, *arguments: Any) -> None:
        """See `modules.Kernels`.

        Raises:
            KernelError: The kernel read or wrote out of bounds, had a race, or its threads did not meet.
        """
        signature = self._signatures[name]
        grid, block = signature.sizes(grid, block)
        packed = signature.pack(arguments)
        _check_overlap(signature.kernel, packed, arguments)
        if 0 in grid:
            return
        pointers = (ctypes.c_void_p * len(packed))(*(ctypes.addressof(value) for value in packed))
        sizes = ((ctypes.c_uint * 3)(*grid), (ctypes.c_uint * 3)(*block))
        prepare = getattr(self._library, f"emulated_{name}")
        with LOCK:
            error = self._library.emulated_launch(
                name.encode(), prepare, pointers, *sizes, ctypes.c_ulonglong(self.seed), ctypes.byref(STACKS)
            )
            self._library.emulated_work(ctypes.byref(self.work))
        if error:
            raise KernelError(error.decode())

    def _check_structures(self, kernel: Kernel) -> None:
        """Raise TypeError where a structure has another size in Python than in C++."""
        sizes = (ctypes.c_longlong * (len(kernel.parameters) + 1))()
        count = getattr(self._library, f"emulated_sizes_{kernel.name}")(sizes)
        if count != len(kernel.parameters):
            raise TypeError(
                f"kernel {kernel.name}: {count} parameters, of which {len(kernel.parameters)} are understood"
            )
        for parameter, size in zip(kernel.parameters, sizes, strict=False):
            structure = self.source.structures.get(parameter.type)
            if structure and ctypes.sizeof(structure) != size:
                raise TypeError(
                    f"kernel {kernel.name}, {parameter.name}: {parameter.type} has {size} bytes, "
                    f"{structure.__name__} {ctypes.sizeof(structure)}"
                )


def _check_overlap(kernel: Kernel, packed: Sequence[Any], arguments: Sequence[Any]) -> None:
    """Raise TypeError for buffers that share some of their memory: races between them would not be found."""
    ends = [
        (value.data, value.data + tensor.nbytes, parameter)
        for parameter, value, tensor in zip(kernel.parameters, packed, arguments, strict=True)
        if isinstance(value, BufferArgument) and value.size
    ]
    for i, (start, end, first) in enumerate(ends):
        for other_start, other_end, second in ends[:i]:
            same = (start, end, first.type) == (other_start, other_end, second.type)
            if start < other_end and other_start < end and not same and not (first.is_const and second.is_const):
                raise TypeError(f"kernel {kernel.name}: {second.name} and {first.name} share memory")


@cache
def compiler() -> str:
    """The C++ compiler: $CXX, or the first of those that are common.

    Raises:
        BadInput: There is none.
    """
    wanted = os.environ.get("CXX")
    for name in (wanted,) if wanted else ("g++", "c++", "clang++"):
        if path := shutil.which(name):
            return path
    raise BadInput(
        f"the emulator of CUDA kernels needs a C++ compiler, found no {wanted or 'g++'}; install GCC or Clang"
    )


def _with_tail(source: CudaSource) -> str:
    """The text of a source, and behind it how to call each of its kernels."""
    kernels = source.kernels.values()
    calls = [[kernel.name, *(f'"{parameter.name}"' for parameter in kernel.parameters)] for kernel in kernels]
    return source.text + "".join(f"EMULATED_KERNEL({', '.join(call)})\n" for call in calls)


@cache
def _library(text: str, name: str, flags: Sequence[str]) -> ctypes.CDLL:
    """The library of a source, loaded once per process and compiled once per user."""
    key = sha256(repr((text, flags, compiler())).encode())
    for header in sorted((CUDA_FOLDER / "emulator").iterdir()):
        key.update(header.read_bytes())
    path = cache_root() / "cuda" / f"{name}-emulated-{key.hexdigest()[:24]}.so"
    if not path.exists():
        _compile(text, path, flags)
    library = ctypes.CDLL(str(path))
    library.emulated_launch.restype = ctypes.c_char_p
    return library


def _compile(text: str, path: Path, flags: Sequence[str]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        file, library = Path(folder) / "source.cpp", Path(folder) / path.name
        file.write_text(text, encoding="utf-8")
        done = subprocess.run([compiler(), *flags, str(file), "-o", str(library)], capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(f"{path.stem}: does not compile for the emulator\n{done.stderr}")
        library.replace(path)
