"""The device decides which rasterizer draws."""

import warnings
from dataclasses import dataclass
from typing import ClassVar

import pytest
import torch
from needs import needs_native

from surfkit import hookimpl, native
from surfkit.core import registry
from surfkit.core.check import BadInput
from surfkit.raster.native import NativeRasterizer
from surfkit.raster.reference import Reference
from surfkit.raster.select import select, torch_device


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


@dataclass(frozen=True)
class OnCuda(Reference):
    device: ClassVar[str] = "cuda"


@pytest.fixture
def on_cuda(monkeypatch):
    """A registered rasterizer of a package that draws on a CUDA device."""

    class Package:
        @hookimpl
        def surfkit_components(self):
            return {"on-cuda": OnCuda}

    registry.plugins().register(Package(), "cuda-package")
    yield
    registry.plugins().unregister(name="cuda-package")


@pytest.mark.parametrize(
    ("device", "without", "with_cuda"),
    [
        ("auto", "cpu", "cuda"),
        ("cpu", "cpu", "cpu"),
        ("cuda", None, "cuda"),
        ("native", "cpu", "cpu"),
        ("reference", "cpu", "cpu"),
        ("on-cuda", None, "cuda"),
    ],
)
def test_torch_computes_where_the_rasterizer_draws(monkeypatch, on_cuda, device, without, with_cuda):
    """None: refused. `auto` takes CUDA for what torch computes, also where no rasterizer draws there."""
    for there, wanted in ((False, without), (True, with_cuda)):
        monkeypatch.setattr(torch.cuda, "is_available", lambda there=there: there)
        if wanted is None:
            with pytest.raises(BadInput, match=f"--device {device}: torch finds no CUDA device here; use --device cpu"):
                torch_device(device)
        else:
            assert torch_device(device) == torch.device(wanted)


def test_a_device_that_nobody_knows_is_refused_also_where_only_torch_computes():
    with pytest.raises(BadInput, match="nativ.* native"):
        torch_device("nativ")
