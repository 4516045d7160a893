"""What a report of a bug needs to know of a machine: versions, devices, and how the compiled kernels were built."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import re
from dataclasses import dataclass
from pathlib import Path

import psutil
import torch

from surfkit.core.registry import Plugin, components, records
from surfkit.core.version import own_version
from surfkit.raster import native
from surfkit.raster.base import Rasterizer


@dataclass(frozen=True)
class Gpu:
    """A GPU that torch finds.

    Attributes:
        name: As its driver has it.
        capability: CUDA compute capability, such as "9.0".
        memory_bytes: All of it, also what is in use.
    """

    name: str
    capability: str
    memory_bytes: int


@dataclass(frozen=True)
class Native:
    """The compiled kernels.

    Attributes:
        file: Name of the extension module, which tells its ABI; None if there is none.
        compiler: Compiler and version; None if there is no module.
        kernels: Compilations that run on this processor, the best first.
        in_use: The one that is used; None if there is no module.
        lacking: Why there is no module, and what to do; None if there is one.
    """

    file: str | None = None
    compiler: str | None = None
    kernels: tuple[str, ...] = ()
    in_use: str | None = None
    lacking: str | None = None


@dataclass(frozen=True)
class Machine:
    """What surfkit runs on. Where nothing is wrong it names no folder, host or user: people show it to others.

    Attributes:
        surfkit: Its version.
        python: Version of Python.
        system: Operating system, processor architecture and C library.
        processors: Number of logical processors.
        threads: How many threads torch computes with.
        memory_bytes: All of it, also what is in use.
        cuda: Version of CUDA that torch was built for; None for a build without.
        gpus: In the order of their numbers, as in `--device cuda:1`.
        native: The compiled kernels.
        rasterizers: By name, the title of those that run here, and why others do not.
        packages: Versions of the packages that surfkit and its extras ask for and that are installed, by name.
        plugins: Those that are installed, with what is wrong with those that are not in use.
    """

    surfkit: str
    python: str
    system: str
    processors: int
    threads: int
    memory_bytes: int
    cuda: str | None
    gpus: tuple[Gpu, ...]
    native: Native
    rasterizers: dict[str, str]
    packages: dict[str, str]
    plugins: tuple[str, ...]


def machine() -> Machine:
    """This one."""
    rasterizers = {name: cls() for name, cls in components(Rasterizer).items()}
    return Machine(
        surfkit=own_version(),
        python=platform.python_version(),
        system=platform.platform(),
        processors=os.cpu_count() or 1,
        threads=torch.get_num_threads(),
        memory_bytes=psutil.virtual_memory().total,
        cuda=torch.version.cuda,
        gpus=tuple(map(_gpu, range(torch.cuda.device_count()))) if torch.cuda.is_available() else (),
        native=_native(),
        rasterizers={name: each.missing() or each.title() for name, each in rasterizers.items()},
        packages=_packages(),
        plugins=tuple(f"{each}: {each.error}" if each.error else str(each) for each in records() if _is_foreign(each)),
    )


def _is_foreign(plugin: Plugin) -> bool:
    return plugin.distribution not in ("", "surfkit")


def _gpu(number: int) -> Gpu:
    found = torch.cuda.get_device_properties(number)
    return Gpu(found.name, f"{found.major}.{found.minor}", found.total_memory)


def _native() -> Native:
    if native.module() is None:
        return Native(lacking=native.lacking())
    module = native.kernels()
    return Native(Path(module.__file__).name, module.compiler, tuple(module.kernels()), module.kernels_in_use())


def _packages() -> dict[str, str]:
    try:
        asked = importlib.metadata.requires("surfkit") or []
    except importlib.metadata.PackageNotFoundError:  # a bare source tree
        asked = []
    found = {}
    for name in sorted({start[0] for line in asked if (start := re.match(r"[\w.-]+", line))}, key=str.lower):
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found
