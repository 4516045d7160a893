"""What a test needs and not every machine has: without it the test is skipped, and says what is missing."""

import importlib
from types import ModuleType

import pytest

from surfkit.core.check import BadInput
from surfkit.core.optional import needed
from surfkit.raster import native

NO_NATIVE = "surfkit was installed without its native module, as no C++ compiler or no Python headers were found"
needs_native = pytest.mark.skipif(native.module() is None, reason=NO_NATIVE)
"""Marks a test of the native module, or one that takes minutes with the reference rasterizer in its place."""


def needs(module: str, what: str = "this test") -> ModuleType:
    """The module; where it cannot be loaded, whatever stops it, the test or file of tests that asks for it is skipped.

    No test imports an optional package in another way: `test_bare.py` sees to it.
    """
    try:
        with needed(module.partition(".")[0], what):
            return importlib.import_module(module)
    except BadInput as error:
        pytest.skip(str(error), allow_module_level=True)
