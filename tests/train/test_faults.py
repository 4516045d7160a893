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


def saved(out):
    """Let there be a checkpoint in a run folder."""
    (out / "pretrain").mkdir()
    (out / "pretrain" / "checkpoint.safetensors").touch()


@pytest.mark.parametrize("fails", [real_cpu_error, python_error, cuda_error])
def test_out_of_memory_says_what_to_lower(fails, tmp_path):
    told = rf"{tmp_path}: out of (GPU )?memory.*--longest.*--pretrain.densify.threshold"
    with pytest.raises(Fault, match=f"{told}.*; no checkpoint"):
        with in_one_line(tmp_path):
            fails()
    saved(tmp_path)
    with pytest.raises(Fault, match=f"{told}.*; the last checkpoint"):
        with in_one_line(tmp_path):
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


@pytest.mark.parametrize(
    ("kept", "told"),
    [
        (None, "free some space, and give the same command again"),
        (
            "pretrain/checkpoint.safetensors",
            "the last checkpoint in .* is whole: free some space, and the same command",
        ),
        ("pretrain/checkpoint-before.safetensors", "the last checkpoint in .* is whole: free some space"),
        ("blocks/003/tune/checkpoint.safetensors", "the last checkpoint in .* is whole: free some space"),
        ("method/state.pt", "the last checkpoint in .* is whole: free some space"),
        ("pretrain/other.txt", "free some space, and give the same command again"),
    ],
)
def test_a_full_disk_is_one_line_that_claims_no_checkpoint_that_is_not_there(tmp_path, kept, told):
    if kept is not None:
        (tmp_path / kept).parent.mkdir(parents=True)
        (tmp_path / kept).touch()
    with pytest.raises(Fault, match=rf"^/dev/full: the disk is full \(.*\)[;:] {told}"):
        with in_one_line(tmp_path):
            file = os.open("/dev/full", os.O_WRONLY)
            try:
                os.write(file, b"x")
            except OSError as error:
                raise OSError(error.errno, error.strerror, "/dev/full") from error
            finally:
                os.close(file)
