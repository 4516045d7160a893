import errno
import os
from pathlib import Path

import pytest
import torch

from surfkit.core.check import Fault
from surfkit.core.memory import is_out_of_gpu_memory, is_out_of_memory, out_of_memory
from surfkit.train.faults import in_one_line


def real_cpu_error():
    torch.empty(2**60, dtype=torch.uint8)


def python_error():
    raise MemoryError


def cuda_error():
    raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB")


@pytest.mark.parametrize("fails", [real_cpu_error, python_error, cuda_error])
def test_out_of_memory_says_what_to_lower(fails):
    with pytest.raises(
        Fault, match=r"run: out of (GPU )?memory.*--longest.*--pretrain.densify.threshold.*checkpoint is whole"
    ):
        with in_one_line(Path("run")):
            fails()


@pytest.mark.parametrize(
    ("error", "on_gpu"),
    [
        (torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB"), True),
        (RuntimeError("CUDA error: out of memory"), True),
        (RuntimeError("cuLaunchKernel on cuda:0: out of memory"), True),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 8 bytes"), False),
        (MemoryError("cuda: out of memory"), False),
    ],
)
def test_which_memory_gave_out(error, on_gpu):
    assert is_out_of_memory(error) and is_out_of_gpu_memory(error) == on_gpu
    assert ("out of GPU memory" in out_of_memory(error)) == on_gpu
    capacity = torch.cuda.OutOfMemoryError(
        "Tried to allocate 2.00 GiB. GPU 0 has a total capacity of 23.64 GiB of which"
    )
    assert out_of_memory(capacity) == "out of GPU memory with 2.00 GiB more wanted and 23.64 GiB there in all"


def test_other_errors_stay_what_they_are():
    for error in (RuntimeError("a bug"), OSError(errno.EACCES, "denied"), ValueError("x")):
        with pytest.raises(type(error)) as found, in_one_line(Path("run")):
            raise error
        assert found.value is error and not is_out_of_memory(error)


def test_a_full_disk_is_one_line():
    with pytest.raises(Fault, match=r"/dev/full: the disk is full .*checkpoint in run is whole: free some space"):
        with in_one_line(Path("run")):
            file = os.open("/dev/full", os.O_WRONLY)
            try:
                os.write(file, b"x")
            except OSError as error:
                raise OSError(error.errno, error.strerror, "/dev/full") from error
            finally:
                os.close(file)
