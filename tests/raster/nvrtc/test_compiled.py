"""Compiling kernels for GPUs without one, and launching them on a driver that only notes what it is given."""

import ctypes
from pathlib import Path

import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.raster.nvrtc import nvrtc as module
from surfkit.raster.nvrtc.arguments import BufferArgument
from surfkit.raster.nvrtc.cuda_source import CudaSource
from surfkit.raster.nvrtc.driver import Driver
from surfkit.raster.nvrtc.modules import Compiled, Emulated, kernels
from surfkit.raster.nvrtc.nvrtc import Nvrtc, image, nvrtc, resources

from .sources import BASIC, KERNELS, SHIPPED, Affine


@pytest.fixture
def compiler():
    try:
        return nvrtc()
    except BadInput as error:
        pytest.skip(str(error))


class Noting:
    """A driver of a GPU that is not there."""

    version, capability = 13000, (9, 0)

    def __init__(self):
        self.calls = []

    def load(self, image):
        self.image = image
        return "module"

    def function(self, module, name):
        assert module == "module" and name.encode() in self.image
        return name

    def launch(self, function, grid, block, arguments):
        self.calls.append((function, grid, block, arguments))


def test_arguments_as_the_driver_takes_them(compiler):
    noting = Noting()
    compiled = Compiled(BASIC, torch.device("cpu"), noting)
    x, out = torch.rand(32, 2), torch.zeros(32, 2)
    compiled.launch("apply", (1, 2), 32, Affine((2, 3), 4), x, out, True)
    ((name, grid, block, (affine, first, second, flag)),) = noting.calls
    assert (name, grid, block) == ("apply", (1, 2, 1), (32, 1, 1))
    assert list(affine.scale) == [2, 3] and affine.shift == 4 and ctypes.sizeof(affine) == 12
    assert isinstance(flag, ctypes.c_bool) and flag.value
    for buffer, tensor in ((first, x), (second, out)):
        assert isinstance(buffer, BufferArgument) and ctypes.sizeof(buffer) == 16
        assert (buffer.data, buffer.size) == (tensor.data_ptr(), 32)  # elements of float2
    compiled.launch("apply", 0, 32, Affine((2, 3), 4), x, out, True)
    assert len(noting.calls) == 1
    with pytest.raises(TypeError, match="takes 4 arguments"):
        compiled.launch("apply", 1, 32, x)


def test_the_device_chooses():
    assert isinstance(kernels(BASIC, torch.device("cpu")), Emulated)
    assert kernels(BASIC, torch.device("cpu")) is kernels(BASIC, torch.device("cpu"))


def test_images_are_kept(compiler, tmp_path, monkeypatch):
    monkeypatch.setenv("SURFKIT_CACHE", str(tmp_path))
    made = []
    compile = Nvrtc.compile
    monkeypatch.setattr(Nvrtc, "compile", lambda *a: made.append(a[2]) or compile(*a))
    other = CudaSource(KERNELS / "basic.cu", defines={"UNUSED": 1})
    first = image(BASIC, "sm_80")
    assert first[:4] == b"\x7fELF" and image(BASIC, "sm_80", 13000) == first and made == ["sm_80"]
    image(other, "sm_80")
    image(BASIC, "sm_90")
    assert made == ["sm_80", "sm_80", "sm_90"]
    assert image(BASIC, "compute_80", 12080).startswith(b"//") and image(BASIC, "compute_80", 13000)
    assert made[3:] == ["compute_80"] * 2  # PTX is the driver's to compile: kept by its version


def test_architectures(compiler, monkeypatch):
    monkeypatch.setattr(compiler, "architectures", [75, 80, 86, 89, 90, 100, 120])
    chosen = {(7, 5): "sm_75", (8, 7): "sm_86", (8, 9): "sm_89", (9, 0): "sm_90", (10, 3): "sm_100", (12, 1): "sm_120"}
    assert {key: compiler.architecture(key) for key in chosen} == chosen
    assert compiler.architecture((13, 0)) == "compute_120"  # newer than the compiler
    with pytest.raises(BadInput, match=r"capability 7\.0; .*7\.5"):
        compiler.architecture((7, 0))


def test_mistakes_of_sources_are_shown(compiler, tmp_path):
    (tmp_path / "part.h").write_text("inline int f() { return unknown_name; }\n")
    (tmp_path / "bad.cu").write_text('#include "part.h"\nKERNEL(32) k(Buffer<int> x) { x[0] = f(); }\n')
    with pytest.raises(RuntimeError, match=r'(?s)bad.cu .*sm_80.*part.h\(1\).*"unknown_name"'):
        compiler.compile(CudaSource(tmp_path / "bad.cu"), "sm_80")


def test_resources_are_read(compiler):
    _, log = compiler.compile(BASIC, "sm_90")
    found = resources(log)
    assert found.keys() == BASIC.kernels.keys()
    assert found["transpose"]["shared"] == 8 * 9 * 4 and 8 <= found["transpose"]["registers"] <= 32
    assert all(each["spills"] == 0 for each in found.values())


def test_spills_are_seen(compiler, tmp_path):
    (tmp_path / "many.cu").write_text(
        """KERNEL(1024, 2) many(Buffer<float> x) {
            float v[64];
            for (int i = 0; i < 64; i++) v[i] = x[i * 1024 + threadIdx.x];
            __syncthreads();
            for (int i = 0; i < 64; i++) x[i * 1024 + threadIdx.x] = v[63 - i] * v[i];
        }"""
    )
    _, log = compiler.compile(CudaSource(tmp_path / "many.cu"), "sm_80")
    assert resources(log)["many"]["registers"] <= 32 and resources(log)["many"]["spills"] > 0


def test_the_compiler_of_torchs_cuda_is_taken(tmp_path, monkeypatch):
    for name in ("cu13/lib/libnvrtc.so.13", "cuda_nvrtc/lib/libnvrtc.so.12", "cu13/lib/libnvrtc-builtins.so.13.5"):
        (tmp_path / "nvidia" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "nvidia" / name).touch()
    (tmp_path / "torch" / "lib").mkdir(parents=True)
    (tmp_path / "torch" / "lib" / "libnvrtc-672ee683.so.11.2").touch()  # as some builds of torch bring it
    spec = type("Spec", (), {"submodule_search_locations": [str(tmp_path / "nvidia")]})
    monkeypatch.setattr(module.importlib.util, "find_spec", lambda name: spec)
    monkeypatch.setattr(torch, "__file__", str(tmp_path / "torch" / "__init__.py"))

    def found(major):
        return [name.removeprefix(f"{tmp_path}/") for name in module._names(major)]

    assert found("13") == ["nvidia/cu13/lib/libnvrtc.so.13", "libnvrtc.so.13"]
    assert found("12") == ["nvidia/cuda_nvrtc/lib/libnvrtc.so.12", "libnvrtc.so.12"]
    assert found("11") == ["torch/lib/libnvrtc-672ee683.so.11.2", "libnvrtc.so.11"]
    assert len(found("")) == 5


def test_no_compiler_says_which_package(monkeypatch):
    monkeypatch.setattr(module, "_names", lambda major: iter(["no-such-library"]))
    for cuda, package in (("12.8", "nvidia-cuda-nvrtc-cu12"), ("13.0", "nvidia-cuda-nvrtc")):
        monkeypatch.setattr(torch.version, "cuda", cuda)
        nvrtc.cache_clear()
        with pytest.raises(BadInput, match=f"NVRTC.*; pip install {package}$"):
            nvrtc()
    nvrtc.cache_clear()


@pytest.mark.skipif(torch.cuda.is_available(), reason="has a GPU")
def test_no_driver():
    try:
        ctypes.CDLL("libcuda.so.1")
    except OSError:
        with pytest.raises(BadInput, match="--device cuda:0: .*no NVIDIA driver.*--device cpu"):
            Driver(torch.device("cuda:0"))
    else:
        pytest.skip("has a driver, but no GPU")


class Refusing:
    """The driver's library, where loading gives an error."""

    def __init__(self, status):
        self.status = status

    def __getattr__(self, name):
        def call(*arguments):
            if name == "cuGetErrorString":
                arguments[1]._obj.value = b"no kernel image is available"
                return 0
            return self.status if name == "cuModuleLoadData" else 0

        return call


def test_an_old_driver_is_named(monkeypatch):
    monkeypatch.setattr(ctypes, "CDLL", lambda name: Refusing(209))
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (8, 0))
    with pytest.raises(BadInput, match=r"209\); update the driver"):
        Driver(torch.device("cuda:0")).load(b"")
    monkeypatch.setattr(ctypes, "CDLL", lambda name: Refusing(2))
    with pytest.raises(RuntimeError, match="cuModuleLoadData on cuda:0"):
        Driver(torch.device("cuda:0")).load(b"")


def test_a_launch_calls_the_driver(monkeypatch):
    called = []

    class Recording(Refusing):
        def __getattr__(self, name):
            return lambda *arguments: called.append((name, arguments)) or 0

    monkeypatch.setattr(ctypes, "CDLL", lambda name: Recording(0))
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: (8, 0))
    monkeypatch.setattr(torch.cuda, "current_stream", lambda device: type("Stream", (), {"cuda_stream": 77})())
    backend = Driver(torch.device("cuda:0"))
    called.clear()
    number = ctypes.c_int(5)
    backend.launch(ctypes.c_void_p(9), (2, 3, 4), (32, 1, 1), [number])
    assert [name for name, _ in called] == ["cuCtxPushCurrent_v2", "cuLaunchKernel", "cuCtxPopCurrent_v2"]
    function, *sizes, shared, stream, pointers, extra = called[1][1]
    assert (function.value, sizes, shared, stream.value, extra) == (9, [2, 3, 4, 32, 1, 1], 0, 77, None)
    assert ctypes.cast(pointers[0], ctypes.POINTER(ctypes.c_int)).contents.value == 5


def test_every_source_is_listed():
    root = Path(__file__).parents[3] / "surfkit"
    assert {source.path for source, _ in SHIPPED} == set(root.rglob("*.cu"))


@pytest.mark.parametrize("architecture", [75, 86, 90, 120])  # one of each layout of registers and shared memory
def test_every_kernel_compiles_within_its_limits(compiler, architecture):
    if architecture not in compiler.architectures:
        pytest.skip(f"NVRTC {compiler.version} does not know sm_{architecture}")
    for source, limits in SHIPPED:
        found = resources(compiler.compile(source, f"sm_{architecture}")[1])
        assert found.keys() == limits.keys() == source.kernels.keys()
        for name, (registers, shared, *stack) in limits.items():
            used = found[name]
            assert used["registers"] <= registers and used["shared"] <= shared, (name, used)
            assert used["stack"] <= (stack[0] if stack else 0), (name, used)
            assert used["spills"] <= (100 if stack else 0), (name, used)
