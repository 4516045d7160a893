"""NVIDIA's run-time compiler, from the package that every CUDA build of torch installs.

It is called through ctypes: its C interface has been the same since CUDA 11.1, while cuda-bindings comes only with
torch 2.10 and later.
"""

from __future__ import annotations

import ctypes
import importlib.util
import re
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import torch

from surfkit.core.caches import cache_root
from surfkit.core.check import BadInput
from surfkit.core.files import replacing
from surfkit.raster.nvrtc.cuda_source import CudaSource

COMPILER_OPTIONS = ("--std=c++17", "--device-as-default-execution-space", "--ptxas-options=-v")
SEPARATE_ROUNDING_OPTION = "--fmad=false"
"""Of sources whose products and sums are each rounded."""
MIN_COMPUTE_CAPABILITY = 70
"""Least compute capability, times ten: before it, the threads of a warp could not go separate ways."""


class Nvrtc:
    """The library at a path or of a name; see `nvrtc`."""

    def __init__(self, name: str) -> None:
        self._library = ctypes.CDLL(name)
        self._library.nvrtcGetErrorString.restype = ctypes.c_char_p
        major, minor, count = ctypes.c_int(), ctypes.c_int(), ctypes.c_int()
        self._call("nvrtcVersion", ctypes.byref(major), ctypes.byref(minor))
        self._call("nvrtcGetNumSupportedArchs", ctypes.byref(count))
        supported = (ctypes.c_int * count.value)()
        self._call("nvrtcGetSupportedArchs", supported)
        self.version: tuple[int, int] = (major.value, minor.value)
        self.architectures: list[int] = sorted(supported)

    def compile(self, source: CudaSource, architecture: str) -> tuple[bytes, str]:
        """The compiled image of a source, and what the compiler says of its kernels.

        Args:
            source: See `CudaSource`.
            architecture: sm_90 for a cubin of this compute capability, compute_90 for PTX, which the driver compiles.

        Raises:
            RuntimeError: The source is not valid; has the compiler's messages.
        """
        program = ctypes.c_void_p()
        text, name = source.text.encode(), source.path.name.encode()
        self._call("nvrtcCreateProgram", ctypes.byref(program), text, name, 0, None, None)
        try:
            options = [option.encode() for option in (f"--gpu-architecture={architecture}", *_options(source))]
            failed = self._library.nvrtcCompileProgram(
                program, len(options), (ctypes.c_char_p * len(options))(*options)
            )
            log = self._get(program, "ProgramLog").rstrip(b"\0").decode(errors="replace")
            if failed:
                raise RuntimeError(f"{source.path.name} does not compile for {architecture}\n{log}")
            return self._get(program, "CUBIN" if architecture.startswith("sm") else "PTX"), log
        finally:
            self._call("nvrtcDestroyProgram", ctypes.byref(program))

    def architecture(self, capability: tuple[int, int]) -> str:
        """What to compile for a GPU: the newest cubin that runs there, or PTX if the GPU is newer than this compiler.

        Raises:
            BadInput: The GPU is too old.
        """
        wanted = capability[0] * 10 + capability[1]
        fitting = [a for a in self.architectures if MIN_COMPUTE_CAPABILITY <= a <= wanted]
        if not fitting:
            known = f"{max(self.architectures[0], MIN_COMPUTE_CAPABILITY) / 10:.1f}"
            raise BadInput(
                f"the GPU has compute capability {wanted / 10:.1f}; surfkit with CUDA {self.version[0]} "
                f"needs {known} or newer; use --device cpu, or, from 7.0 on, a build of torch for CUDA 12"
            )
        newest = fitting[-1]
        return f"sm_{newest}" if newest // 10 == capability[0] else f"compute_{newest}"

    def _get(self, program: ctypes.c_void_p, what: str) -> bytes:
        size = ctypes.c_size_t()
        self._call(f"nvrtcGet{what}Size", program, ctypes.byref(size))
        text = ctypes.create_string_buffer(max(1, size.value))
        self._call(f"nvrtcGet{what}", program, text)
        return text.raw[: size.value]

    def _call(self, name: str, *arguments: Any) -> None:
        if status := getattr(self._library, name)(*arguments):
            raise RuntimeError(f"{name}: {self._library.nvrtcGetErrorString(status).decode()}")


@cache
def nvrtc() -> Nvrtc:
    """The compiler whose major version is that of torch's CUDA, which the driver is known to support.

    Raises:
        BadInput: None is installed.
    """
    major = (torch.version.cuda or "").split(".")[0]
    for name in _names(major):
        with suppress(OSError):
            return Nvrtc(name)
    package = "nvidia-cuda-nvrtc" + (f"-cu{major}" if major and int(major) < 13 else "")
    raise BadInput(f"found no NVRTC, NVIDIA's run-time compiler{f' {major}' if major else ''}; pip install {package}")


def image(source: CudaSource, architecture: str, driver_version: int = 0) -> bytes:
    """What `Nvrtc.compile` gives, from the user's cache if it was compiled before."""
    compiler = nvrtc()
    made_by = compiler.version, architecture, architecture.startswith("compute") and driver_version
    key = (source.text, _options(source), *made_by)
    name = f"{source.path.stem}-{architecture}-{sha256(repr(key).encode()).hexdigest()[:24]}"
    path = cache_root() / "cuda" / name
    if path.exists():
        return path.read_bytes()
    made, _ = compiler.compile(source, architecture)
    with replacing(path) as file:
        file.write(made)
    return made


def _options(source: CudaSource) -> tuple[str, ...]:
    return (*COMPILER_OPTIONS, SEPARATE_ROUNDING_OPTION) if source.is_exact else COMPILER_OPTIONS


def resources(log: str) -> dict[str, dict[str, int]]:
    """By kernel: registers, bytes of spills, stack and shared memory, of the log of a cubin."""
    out = {}
    parts = re.split(r"Compiling entry function '(\w+)'", log)
    for name, text in zip(parts[1::2], parts[2::2], strict=True):
        found = {
            "registers": r"Used (\d+) registers",
            "spills": r"(\d+) bytes spill stores",
            "stack": r"(\d+) bytes stack frame",
            "shared": r"(\d+) bytes smem",
        }
        numbers = {key: re.search(pattern, text) for key, pattern in found.items()}
        out[name] = {key: int(match[1]) if match else 0 for key, match in numbers.items()}
    return out


def _names(major: str) -> Iterator[str]:
    """Where the library may be: with torch, in NVIDIA's Python packages, in the system."""
    folders = [Path(torch.__file__).parent / "lib"]
    spec = importlib.util.find_spec("nvidia")
    for root in (spec.submodule_search_locations or ()) if spec else ():
        folders += Path(root).glob("*/lib")
    for folder in folders:
        for path in sorted(folder.glob("libnvrtc*.so.*"), reverse=True):
            if re.fullmatch(rf"libnvrtc(-[0-9a-f]+)?\.so\.{major or '[0-9]+'}(\.[\d.]+)?", path.name):
                yield str(path)
    yield from (f"libnvrtc.so.{version}" for version in ([major] if major else ["13", "12"]))
