"""What a script may have set in torch, set back while surfkit trains."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext

import torch


@contextmanager
def own_torch_state() -> Iterator[None]:
    """Within, what torch makes is float32 on the CPU and has gradients, whatever the script around it has set.

    Training would stop under `no_grad`, with float64 as default, or with another device as default.
    """
    before = torch.get_default_dtype()
    is_cpu = torch.empty(0).device.type == "cpu"
    torch.set_default_dtype(torch.float32)
    try:
        # a default device is looked at in every call of torch, so none is set without need
        with nullcontext() if is_cpu else torch.device("cpu"), torch.inference_mode(False), torch.enable_grad():
            yield
    finally:
        torch.set_default_dtype(before)
