"""The compiled kernels of all folders, in one extension module, and what they share: threads, vectors, buffers."""

from __future__ import annotations

import os
from functools import cache
from types import ModuleType

from surfkit.core.check import BadInput


@cache
def module() -> ModuleType | None:
    """The compiled extension, or None where surfkit was installed without a compiler.

    SURFKIT_KERNELS=avx512|avx2|baseline picks one compilation of the kernels; by default the best that runs is used.
    """
    try:
        from surfkit.native import _native
    except ImportError:
        return None
    if wanted := os.environ.get("SURFKIT_KERNELS"):
        if wanted not in _native.kernels():
            raise BadInput(f"SURFKIT_KERNELS={wanted}: this machine can run {', '.join(_native.kernels())}")
        _native.use_kernels(wanted)
    return _native
