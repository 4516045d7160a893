"""The compiled kernels of all folders, in one extension module, and what they share: threads, vectors, buffers."""

from __future__ import annotations

import importlib
import os
from functools import cache
from types import ModuleType
from typing import Any

from surfkit.core.check import BadInput


@cache
def module() -> ModuleType | None:
    """The compiled extension, or None where there is none or it cannot be loaded; `lacking` tells why.

    SURFKIT_KERNELS=avx512|avx2|baseline picks one compilation of the kernels; by default the best that runs is used.
    """
    try:
        from surfkit.raster.native import _native
    except ImportError:
        return None
    if wanted := os.environ.get("SURFKIT_KERNELS"):
        if wanted not in _native.kernels():
            raise BadInput(f"SURFKIT_KERNELS={wanted}: this machine can run {', '.join(_native.kernels())}")
        _native.use_kernels(wanted)
    return _native


def kernels() -> Any:
    """The compiled extension, for those who have asked `module` whether there is one.

    Raises:
        RuntimeError: There is none.
    """
    found = module()
    if found is None:
        raise RuntimeError(lacking())
    return found


def lacking() -> str:
    """Why there is no `module`, and what to do, in one line."""
    try:
        importlib.import_module("surfkit.raster.native._native")
    except ModuleNotFoundError:
        pass
    except ImportError as error:
        said = " ".join(str(error).split())
        return (
            f"the compiled kernels of surfkit cannot be loaded ({said}); install surfkit again from its sources, where "
            "there is a C++ compiler"
        )
    return (
        "surfkit was installed without its compiled kernels (no C++ compiler or no Python headers were found); install "
        "GCC or Clang and the headers, then surfkit again"
    )
