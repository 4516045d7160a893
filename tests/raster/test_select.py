"""The device decides which rasterizer draws."""

import warnings
from dataclasses import dataclass
from typing import ClassVar
from unittest.mock import Mock

import pytest
import torch
from needs import needs_native

from surfkit import hookimpl
from surfkit.core import registry
from surfkit.core.check import BadInput
from surfkit.raster import native
from surfkit.raster.cuda import gpu
from surfkit.raster.cuda.gpu import CudaRasterizer
from surfkit.raster.native_rasterizer import NativeRasterizer
from surfkit.raster.reference import Reference
from surfkit.raster.select import select, torch_device


def test_without_the_compiled_module_the_reference_draws_with_one_warning(monkeypatch):
    monkeypatch.setattr(native, "module", lambda: None)
    monkeypatch.setattr("surfkit.raster.select.warnings", warnings)  # not the skip of conftest.py
    with pytest.warns(UserWarning, match="without its compiled kernels") as warned:
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
            with pytest.raises(BadInput, match=f"--device {device}: .*no CUDA device .*--device cpu"):
                torch_device(device)
        else:
            assert torch_device(device) == torch.device(wanted)


def test_a_device_that_nobody_knows_is_refused_also_where_only_torch_computes():
    with pytest.raises(BadInput, match="nativ.* native"):
        torch_device("nativ")


def test_a_gpu_by_its_number(monkeypatch, on_cuda):
    taken = []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setattr(torch.cuda, "set_device", taken.append)
    monkeypatch.setattr(CudaRasterizer, "missing", lambda self: None)
    monkeypatch.setattr(CudaRasterizer, "title", lambda self: "cuda:1 GPU")
    assert select("cuda:1") == (CudaRasterizer(), "cuda:1 GPU") and torch_device("cuda:1") == torch.device("cuda")
    assert taken == [1, 1]
    for ask in (select, torch_device):
        with pytest.raises(BadInput, match="--device cuda:2: .*2 .*cuda:1"):
            ask("cuda:2")
        with pytest.raises(BadInput, match="'cuda:x'"):
            ask("cuda:x")


def test_auto_takes_the_gpu_that_is_there_and_no_cpu_in_its_place(monkeypatch):
    monkeypatch.setattr(CudaRasterizer, "title", lambda self: "cuda:0 GPU")
    assert select("auto")[0].device == "cpu"
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(CudaRasterizer, "missing", lambda self: None)
    assert select("auto") == select("cuda") == (CudaRasterizer(), "cuda:0 GPU")
    monkeypatch.setattr(CudaRasterizer, "missing", lambda self: "the driver is too old; update it, or use --device cpu")
    for device in ("auto", "cuda", "nvidia"):
        with pytest.raises(BadInput, match=f"--device {device}: the driver is too old"):
            select(device)
    assert select("cpu")[0].device == "cpu"


def test_what_a_gpu_lacks(monkeypatch):
    """One thing after the other is put right."""
    rasterizer = CudaRasterizer()
    monkeypatch.setattr(torch.version, "cuda", None)
    assert "one without CUDA" in rasterizer.missing()
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert "no NVIDIA GPU or driver" in rasterizer.missing()
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "GPU")
    monkeypatch.setattr(gpu, "driver", Mock(side_effect=BadInput("no driver; install one")))
    assert rasterizer.missing() == "no driver; install one"
    monkeypatch.setattr(gpu, "driver", Mock())
    monkeypatch.setattr(gpu, "nvrtc", Mock())
    for capability, built, lacks in [
        ((9, 0), ["sm_80", "sm_90"], False),
        ((8, 9), ["sm_75", "sm_86"], False),
        ((12, 0), ["sm_80", "sm_90"], True),
        ((12, 0), ["sm_80", "compute_90"], False),
        ((7, 5), ["sm_80", "compute_80"], True),
        ((9, 0), ["sm_80", "sm_90a"], False),
    ]:
        monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device, capability=capability: capability)
        monkeypatch.setattr(torch.cuda, "get_arch_list", lambda built=built: built)
        said = rasterizer.missing()
        assert (said is not None) == lacks, (capability, built, said)
        assert not lacks or f"no kernels for GPU (sm_{capability[0]}{capability[1]}; it has {', '.join(built)})" in said
