"""The memory of the GPU that torch uses: how much of it tensors have held, and how much is free."""

from __future__ import annotations

import torch


def peak_gpu_bytes() -> int:
    """The most bytes that tensors have held on the GPU since the last `reset_peak_gpu`; 0 without one.

    What torch keeps in reserve and the driver's own share, some hundred MB, come on top.
    """
    return torch.cuda.max_memory_allocated()


def reset_peak_gpu() -> None:
    """Let `peak_gpu_bytes` count from what is held now."""
    if peak_gpu_bytes():
        torch.cuda.reset_peak_memory_stats()


def free_gpu_bytes() -> int:
    """What the GPU has free, with what torch keeps in reserve. There is one."""
    return torch.cuda.mem_get_info()[0] + torch.cuda.memory_reserved() - torch.cuda.memory_allocated()


def release_gpu() -> None:
    """Hand what torch keeps in reserve back to the driver, so that one large piece can be had instead of many small."""
    torch.cuda.empty_cache()
