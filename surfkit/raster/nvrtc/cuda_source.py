"""CUDA C++ sources: their text with all includes, and the kernels that they declare."""

from __future__ import annotations

import ctypes
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

CUDA_FOLDER = Path(__file__).parent
PRELUDE = CUDA_FOLDER / "prelude.h"

SCALAR_TYPES: Mapping[str, type] = {
    "bool": ctypes.c_bool,
    "int": ctypes.c_int,
    "unsigned": ctypes.c_uint,
    "long long": ctypes.c_longlong,
    "unsigned long long": ctypes.c_ulonglong,
    "float": ctypes.c_float,
    "double": ctypes.c_double,
}
"""Types of parameters that a Python number is given for."""

INCLUDE = re.compile(r'(?m)^[ \t]*#[ \t]*include[ \t]+"([^"]+)"[^\n]*$')
KERNEL = re.compile(r"(?m)^KERNEL\(([^)]*)\)\s*(\w+)\s*\(([^)]*)\)")
PARAMETER = re.compile(r"(?:Buffer<\s*(const\s+)?([\w ]+?)\s*>|(?:const\s+)?([\w ]+?))\s+(\w+)")


@dataclass(frozen=True)
class Parameter:
    """One parameter of a kernel: a value, or the elements of a tensor."""

    name: str
    type: str
    """C++ type of the value or of the elements."""
    is_buffer: bool
    is_const: bool = False


@dataclass(frozen=True)
class Kernel:
    """What a source declares of a kernel."""

    name: str
    parameters: tuple[Parameter, ...]
    threads: int | None
    """Threads that a block may have; None where the source says it with an expression."""


@dataclass(frozen=True, eq=False)
class CudaSource:
    """A CUDA source and what is defined for it.

    Attributes:
        path: The .cu file. It includes other files of surfkit by relative paths; `prelude.h` is in front of it.
        defines: Macros by name, such as a number of channels that the compiler is to know.
        structures: Structures that kernels take by value or as elements of buffers, by their C++ name.
        is_exact: No product and sum are joined into one rounding, so that the kernels give the bits of the CPU.
    """

    path: Path
    defines: Mapping[str, int] = field(default_factory=dict)
    structures: Mapping[str, type[ctypes.Structure]] = field(default_factory=dict)
    is_exact: bool = False

    @cached_property
    def text(self) -> str:
        """The whole source, with the files that it includes in place, each once."""
        defines = "".join(f"#define {name} {value}\n" for name, value in self.defines.items())
        seen: set[Path] = set()
        return defines + _resolved(PRELUDE, seen) + _resolved(self.path, seen)

    @cached_property
    def kernels(self) -> dict[str, Kernel]:
        """The kernels by name."""
        text = re.sub(r"//[^\n]*", "", self.text)
        found = (_kernel(match, text) for match in KERNEL.finditer(text))
        return {kernel.name: kernel for kernel in found}


def _resolved(path: Path, seen: set[Path]) -> str:
    """The text of a file with its includes in place; errors of compilers name the files."""
    path = path.resolve()
    if path in seen:
        return ""
    seen.add(path)
    text = re.sub(r"(?m)^#pragma once$", "", path.read_text(encoding="utf-8"))

    def include(match: re.Match[str]) -> str:
        target = path.parent / match[1]
        if CUDA_FOLDER / "emulator" in target.resolve().parents:
            return match[0]  # for C++ compilers only, which find it themselves
        line = text.count("\n", 0, match.start()) + 2
        return f'{_resolved(target, seen)}#line {line} "{path.name}"'

    return f'#line 1 "{path.name}"\n{INCLUDE.sub(include, text)}\n'


def _kernel(match: re.Match[str], text: str) -> Kernel:
    bound, name, declared = match.groups()
    parameters = tuple(_parameter(part, name) for part in declared.split(",") if part.strip())
    bound = bound.split(",")[0].strip()
    if constant := re.search(rf"constexpr int {re.escape(bound)} = (\d+);", text):
        bound = constant[1]
    return Kernel(name, parameters, int(bound) if bound.isdigit() else None)


def _parameter(text: str, kernel: str) -> Parameter:
    match = PARAMETER.fullmatch(" ".join(text.split()))
    if not match:
        raise ValueError(f"kernel {kernel}: parameter {text.strip()!r} is neither a value nor a Buffer")
    const, element, value, name = match.groups()
    return Parameter(name, element or value, element is not None, const is not None)
