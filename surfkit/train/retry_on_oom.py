"""What a stage does when the memory of the GPU gives out within a step."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from surfkit.core.events import Warned, emit
from surfkit.core.memory import is_out_of_gpu_memory, size
from surfkit.raster.nvrtc.gpu_memory import release_gpu
from surfkit.train.state import StageState
from surfkit.train.uploads import Uploads

Found = TypeVar("Found")


def retry_on_oom(state: StageState, uploads: Uploads, work: Callable[[], Found]) -> Found:
    """What `work` gives, which may change only the order of views and draw random numbers.

    Where the memory of the GPU gives out, it is done once more with what torch keeps in reserve handed back, and then
    without photographs kept there; each time from the same order and random numbers, so that the result is the same.
    The state is as before if that does not help either.

    Raises:
        RuntimeError: Of torch, out of memory.
    """
    order, before = state.order, (state.order.queue, state.order.at, state.generator.get_state())
    for spare in (_release, _keep_nothing, None):
        try:
            return work()
        except RuntimeError as error:
            if not is_out_of_gpu_memory(error):
                raise
            order.queue, order.at = before[:2]
            state.generator.set_state(before[2])
            if spare is None or (spare is _keep_nothing and not uploads.bytes):
                raise
        spare(state, uploads)  # the error and all that it holds are gone by now
    raise AssertionError("the last try returns or raises")


def _release(state: StageState, uploads: Uploads) -> None:
    release_gpu()
    if not uploads.spared:  # it is told once
        uploads.spared = True
        emit(Warned("the memory of the GPU gave out; the step is repeated after torch has handed back its reserve"))


def _keep_nothing(state: StageState, uploads: Uploads) -> None:
    emit(Warned(lowered(uploads, f"step {state.index + 1}: the memory of the GPU gave out again")))


def lowered(uploads: Uploads, why: str) -> str:
    """Keep no photographs on the GPU from now on; what to say of it."""
    freed = uploads.lower()
    release_gpu()
    return f"{why}; {size(freed)} of photographs, masks and depth priors are no longer kept on it"
