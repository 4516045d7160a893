"""The emulator of CUDA kernels: what they compute, and that it finds each of their mistakes."""

import ctypes
from pathlib import Path

import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.raster.nvrtc import emulated
from surfkit.raster.nvrtc.cuda_source import CudaSource
from surfkit.raster.nvrtc.emulated import Emulated, KernelError
from surfkit.raster.nvrtc.modules import kernels

from .conftest import Anywhere
from .sources import BASIC, KERNELS, Affine


@pytest.fixture(scope="module")
def either():
    """The small kernels, with this processor's switch of fibers and with that of the C library."""
    return Emulated(BASIC), Emulated(BASIC, seed=7, flags=("-DEMULATED_UCONTEXT",))


@pytest.fixture(params=["emulated", "permuted", pytest.param("cuda", marks=pytest.mark.cuda)])
def basic(either, request):
    if request.param == "cuda":
        if not torch.cuda.is_available():
            pytest.skip("needs a CUDA device")
        return Anywhere(kernels(BASIC, torch.device("cuda")))
    return either[request.param == "permuted"]


def test_values(basic):
    x, y = torch.rand(1000), torch.zeros(1000)
    basic.launch("halve", 4, 256, x, y)
    assert torch.equal(y, x / 2)


def test_block_reduction(basic):
    x, sums = torch.randn(300), torch.zeros(3)
    basic.launch("block_sums", 3, 128, x, sums)
    expected = torch.nn.functional.pad(x, (0, 84)).view(3, 128).double().sum(1)
    assert torch.allclose(sums.double(), expected, atol=1e-5)


def test_warp_scan(basic):
    x, sums = torch.randint(-9, 9, (64,), dtype=torch.int32), torch.zeros(64, dtype=torch.int32)
    basic.launch("warp_scan", 1, 64, x, sums)
    assert torch.equal(sums, x.view(2, 32).cumsum(1, dtype=torch.int32).flatten())


def test_histogram_with_atomics(basic):
    x, counts = torch.randint(0, 10, (700,), dtype=torch.int32), torch.zeros(10, dtype=torch.int32)
    basic.launch("histogram", 3, 256, x, counts)
    assert torch.equal(counts, torch.bincount(x, minlength=10).int())


def test_blocks_and_grids_of_two_dimensions(basic):
    x, out = torch.rand(13, 21), torch.zeros(21, 13)
    basic.launch("transpose", (3, 2), (8, 8), x, out, 21, 13)
    assert torch.equal(out, x.T)


def test_votes_and_shuffles(basic):
    x, out = torch.arange(32, dtype=torch.int32) - 2, torch.zeros(32, 8, dtype=torch.int32)
    basic.launch("collectives", 1, 32, x, out)
    lanes = torch.arange(32)
    ballot = -(1 << 3)  # lanes 3 and up are positive
    expected = [
        torch.full((32,), ballot), torch.ones(32), torch.ones(32), torch.full((32,), 1), (lanes ^ 1) - 2,
        (lanes - 1).clamp_min(0) - 2, (lanes + 1).clamp_max(31) - 2, (lanes ^ 7) - 2,
    ]  # fmt: skip
    assert torch.equal(out, torch.stack(expected, 1).int())


def test_parts_of_a_warp(basic):
    out, lanes = torch.zeros(32, dtype=torch.int32), torch.arange(32, dtype=torch.int32)
    basic.launch("halves", 1, 32, out)
    assert torch.equal(out, torch.where(lanes < 16, lanes ^ 1, lanes ^ 2))


def test_a_warp_orders_its_accesses(basic):
    x, out = torch.arange(64, dtype=torch.int32), torch.zeros(64, dtype=torch.int32)
    basic.launch("reverse", 1, 64, x, out)
    assert torch.equal(out, x ^ 31)


def test_barriers_that_count(basic):
    out = torch.zeros(3, dtype=torch.int32)
    basic.launch("vote", 1, 64, torch.arange(64, dtype=torch.int32) % 2, out)
    assert out.tolist() == [32, 0, 0]
    basic.launch("vote", 1, 64, torch.arange(64, dtype=torch.int32) + 1, out)
    assert out.tolist() == [64, 1, 1]


def test_structures_and_vectors(basic):
    x, out = torch.arange(64.0).view(32, 2) / 8, torch.zeros(32, 2)  # exact, also with fused multiply-add
    basic.launch("apply", 1, 32, Affine((2, 3), 4), x, out, True)
    assert torch.equal(out, x * torch.tensor([2.0, 3.0]) + 4)
    basic.launch("apply", 1, 32, Affine((2, 3), 4), x, out, False)
    assert torch.equal(out, x * torch.tensor([2.0, 3.0]))


def test_work_is_counted(either):
    x, sums = torch.randn(300), torch.zeros(3)
    either[0].launch("block_sums", 3, 128, x, sums)
    work = either[0].work
    assert list(work.global_bytes) == [300 * 4, 3 * 4, 0] and list(work.shared_bytes) == [3 * 4 * 4, 3 * 4 * 4, 0]
    assert (work.collectives, work.barriers, work.warps) == (3 * 4 * 5, 3, 12)
    counts = torch.zeros(10, dtype=torch.int32)
    either[0].launch("histogram", 1, 256, torch.zeros(200, dtype=torch.int32), counts)
    assert list(work.global_bytes) == [200 * 4, 0, 10 * 4] and list(work.shared_bytes) == [40, 40, 800]


def test_nothing_to_do(basic):
    basic.launch("halve", 0, 256, torch.zeros(0), torch.zeros(0))


FOUND = {
    "beyond_the_end": (8, r"index 8 of x, which has 8 elements"),
    "no_barrier": (64, r"reads part\[\d+\], which (no )?thread"),
    "one_barrier_of_two": (64, r"(writes|reads) part\[\d+\], which thread .* (reads|writes) with no barrier between"),
    "no_syncwarp": (32, r"reads part\[\d+\], which (no )?thread"),
    "half_syncwarp": (32, r"part\[\d+\], which (no )?thread"),
    "syncwarp_between_warps": (64, r"reads part\[\d+\], which (no )?thread"),
    "no_atomic": (1, r"sum\[0\], which (another )?thread .* with no barrier"),
    "no_atomic_between_blocks": (1, r"reads out\[0\], which a thread of another block writes in the same launch"),
    "reads_what_another_block_writes": (3, r"x\[[12]\], which a thread of another block (reads|writes)"),
    "atomic_and_plain": (2, r"x\[0\], which (another )?thread"),
    "global_no_barrier": (128, r"x\[\d+\], which thread .* with no barrier between"),
    "never_written": (64, r"thread \(5, 0, 0\): reads part\[5\], which no thread"),
    "barrier_for_some": (64, r"waits in __syncthreads of line \d+ for thread \(\d+, 0, 0\), which has returned"),
    "two_barriers": (64, r"arrives at __syncthreads of line \d+, .*waits in __syncthreads"),
    "shuffle_for_some": (32, r"waits in __shfl_xor_sync of line \d+ for thread \(\d, 0, 0\), which has returned"),
    "shuffle_of_others": (32, r"reads lane \d+, which is not in its mask 0000ffff"),
    "foreign_mask": (32, r"__any_sync of line \d+ with mask 00000001 lacks its own lane"),
    "half_a_warp": (48, r"but the block has no thread in lane 16"),
    "spins": (2, r"does not end: it is in a loop that reads or writes out"),
    "different_calls": (32, r"waits in __(any|all)_sync of line \d+ for .* which waits in __(all|any)_sync"),
}
BLOCKS = {"no_atomic_between_blocks": 2, "reads_what_another_block_writes": 3}
THREADS = {"no_syncwarp": 32, "half_syncwarp": 32, "atomic_and_plain": 32, "half_a_warp": 48, "shuffle_for_some": 32}
THREADS |= dict.fromkeys(("shuffle_of_others", "foreign_mask", "different_calls", "spins", *BLOCKS), 32)


@pytest.fixture(scope="module")
def wrong():
    return CudaSource(KERNELS / "wrong.cu")


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("name", FOUND)
def test_mistakes_are_found(wrong, name, seed):
    size, message = FOUND[name]
    arguments = [torch.zeros(size, dtype=torch.int32)]
    if name == "beyond_the_end":
        arguments = [torch.zeros(8), torch.zeros(64)]
    with pytest.raises(KernelError, match=f"^kernel {name}, block .*{message}") as error:
        Emulated(wrong, seed=seed).launch(name, BLOCKS.get(name, 1), THREADS.get(name, 64), *arguments)
    assert "\n" not in str(error.value)


def test_every_wrong_kernel_is_tried(wrong):
    assert set(wrong.kernels) == set(FOUND)


def test_a_failed_launch_leaves_no_trace(wrong):
    kernels = Emulated(wrong)
    out = torch.zeros(64, dtype=torch.int32)
    for _ in range(2):
        with pytest.raises(KernelError, match="never_written"):
            kernels.launch("never_written", 1, 64, out)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((torch.zeros(4),), "kernel halve: takes 2 arguments, got 1"),
        (
            (torch.zeros(4), torch.zeros(4).double()),
            r"y: wants .* of torch.float32, .*, got torch.float64 of shape \(4,\)",
        ),
        ((torch.zeros(4), 3), "y: wants a tensor, got int"),
        ((torch.zeros(4), torch.zeros(8)[::2]), "y: wants a contiguous tensor"),
        ((torch.zeros(4), torch.zeros(4, device="meta")), "y: wants a tensor on cpu, got one on meta"),
    ],
)
def test_arguments_are_checked(either, arguments, message):
    with pytest.raises(TypeError, match=message):
        either[0].launch("halve", 1, 256, *arguments)


def test_an_input_that_is_also_written(either):
    """Memory given twice has one record."""
    x = torch.rand(1000)
    expected = x / 2
    either[0].launch("halve", 4, 256, x, x)
    assert torch.equal(x, expected)
    numbers = torch.zeros(64, dtype=torch.int32)
    with pytest.raises(KernelError, match=r"(x|out)\[\d+\], .*barrier"):
        either[0].launch("shift", 1, 64, numbers, numbers)


def test_numbers_and_sizes_are_checked(either):
    x = torch.zeros(13, 21)
    with pytest.raises(TypeError, match="width: .*type int, got 2.5"):
        either[0].launch("transpose", 1, (8, 8), x, x.clone(), 2.5, 13)
    with pytest.raises(TypeError, match="width: 4294967296 .*int"):
        either[0].launch("transpose", 1, (8, 8), x, x.clone(), 2**32, 13)
    with pytest.raises(TypeError, match="up to 256 threads"):
        either[0].launch("halve", 1, 512, x, x.clone())
    with pytest.raises(TypeError, match="a: wants a Affine, got float"):
        either[0].launch("apply", 1, 32, 1.0, torch.zeros(64), torch.zeros(64), True)
    with pytest.raises(TypeError, match="x and y share memory"):
        either[0].launch("halve", 1, 256, x, x.view(-1)[8:])


def test_structures_of_another_size_are_refused():
    class Short(ctypes.Structure):
        _fields_ = (("scale", ctypes.c_float * 2),)

    with pytest.raises(TypeError, match="apply, a: Affine .*12 .*Short 8"):
        Emulated(CudaSource(KERNELS / "basic.cu", structures={"Affine": Short}))


def test_no_compiler(monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    emulated.compiler.cache_clear()
    try:
        with pytest.raises(BadInput, match="no no-such-compiler; .*GCC or Clang"):
            emulated.compiler()
    finally:
        emulated.compiler.cache_clear()


def test_compiled_once(tmp_path, monkeypatch):
    monkeypatch.setenv("SURFKIT_CACHE", str(tmp_path))
    source = tmp_path / "one.cu"
    source.write_text("KERNEL(32) one(Buffer<int> out) { out[threadIdx.x] = NUMBER; }\n")
    for number, files in ((1, 1), (1, 1), (2, 2)):
        out = torch.zeros(32, dtype=torch.int32)
        emulated._library.cache_clear()
        Emulated(CudaSource(source, defines={"NUMBER": number})).launch("one", 1, 32, out)
        assert out.unique().tolist() == [number]
        assert len(list((tmp_path / "cuda").iterdir())) == files


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="counts mappings as Linux tells them")
def test_all_libraries_share_one_set_of_stacks(tmp_path):
    """A process may have some 65,000 mappings, a guarded stack takes two, and a suite loads hundreds of libraries."""
    source = tmp_path / "wide.cu"
    source.write_text("KERNEL(256) wide(Buffer<int> out) { out[threadIdx.x] = NUMBER; }\n")
    guards = []
    for number in range(3):
        Emulated(CudaSource(source, defines={"NUMBER": number})).launch(
            "wide", 1, 256, torch.zeros(256, dtype=torch.int32)
        )
        guards.append(sum(" ---p " in line for line in Path("/proc/self/maps").read_text().splitlines()))
    assert 256 <= guards[0] and guards[-1] < guards[0] + 20  # a library has a few of its own
