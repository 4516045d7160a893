"""The device decides which rasterizer draws."""

import warnings

import pytest
from needs import needs_native

from surfkit import native
from surfkit.core.check import BadInput
from surfkit.raster.native import NativeRasterizer
from surfkit.raster.reference import Reference
from surfkit.raster.select import select


def test_without_the_compiled_module_the_reference_draws_with_one_warning(monkeypatch):
    monkeypatch.setattr(native, "module", lambda: None)
    monkeypatch.setattr("surfkit.raster.select.warnings", warnings)  # not the skip of conftest.py
    with pytest.warns(UserWarning, match="without its compiled rasterizer") as warned:
        rasterizer, name = select()
    assert isinstance(rasterizer, Reference) and name.startswith("cpu reference")
    assert len(warned) == 1


@needs_native
def test_the_compiled_module_is_preferred():
    rasterizer, name = select("cpu")
    assert isinstance(rasterizer, NativeRasterizer)
    assert name == f"cpu {native.module().kernels_in_use()}"


def test_a_device_that_is_not_there_is_refused():
    with pytest.raises(BadInput, match="--device cuda"):
        select("cuda")
