"""What can go wrong inside a run, recognised and said in one line."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import torch
from torch import Tensor

from surfkit.core.check import Fault
from surfkit.core.files import DISK_FULL
from surfkit.core.memory import is_out_of_gpu_memory, is_out_of_memory
from surfkit.core.memory import out_of_memory as say_out_of_memory
from surfkit.train.loss_gradients import as_numbers

MAX_RATE_HALVINGS = 2
"""Times that a run goes back to its last checkpoint with half the learning rates, before it gives up."""


CHECKPOINT = "checkpoint*.safetensors"
"""In the folder of a stage, the last one and the one before."""


class Diverged(RuntimeError):
    """A step made a number that is not finite.

    Attributes:
        index: Of the step.
        view: Name of its photograph.
    """

    def __init__(self, index: int, view: str, what: str) -> None:
        super().__init__(f"step {index}, view {view}: {what}")
        self.index, self.view = index, view


class OutOfMemory(Fault):
    """Memory gave out.

    Attributes:
        what: Has happened, without advice.
    """

    kind = "oom"

    def __init__(self, text: str, what: str) -> None:
        super().__init__(text)
        self.what = what


class NotFinite(Fault):
    """Numbers stay infinite, or none, also with lower learning rates."""

    kind = "nan"


class DiskFull(Fault):
    """There is no room for what a run has to write.

    Attributes:
        what: Has happened, without advice.
    """

    kind = "disk"

    def __init__(self, out: Path, what: str) -> None:
        kept = f"; the last checkpoint in {out} is whole" if has_checkpoint(out) else ""
        how = "the same command goes on from there" if kept else "give the same command again"
        super().__init__(f"{what}{kept}: free some space, and {how}")
        self.what = what


def has_checkpoint(out: Path) -> bool:
    """Whether something is saved, in a run folder or that of a block, that training could go on from."""
    patterns = (f"*/{CHECKPOINT}", f"partition/*/{CHECKPOINT}", f"blocks/*/*/{CHECKPOINT}", "method/**/*")
    return any(path.is_file() for pattern in patterns for path in out.glob(pattern))


def require_finite_losses(index: int, view: str, losses: Mapping[str, float]) -> None:
    """Diverged if the losses of a step are not finite."""
    if not math.isfinite(sum(losses.values())):
        raise Diverged(index, view, f"the losses are {dict(losses)}")


def require_finite_gradients(index: int, view: str, grads: Mapping[str, Tensor]) -> None:
    """Diverged if Adam would make values of a step that are not finite: a gradient, (N, ...), or its square, is not."""
    for name, norm in as_numbers({name: torch.linalg.vector_norm(grad) for name, grad in grads.items()}).items():
        if not math.isfinite(norm):
            raise Diverged(index, view, f"the gradients of the {name} are not finite, or too large")


def require_finite_values(index: int, view: str, params: Mapping[str, Tensor]) -> None:
    """Diverged if a parameter, (N, ...), is not finite after a step. A sum tells, in one pass and without a copy."""
    for name, total in as_numbers({name: value.sum() for name, value in params.items()}).items():
        if not math.isfinite(total) and not torch.isfinite(params[name]).all():
            raise Diverged(index, view, f"the {name} are not finite")


@contextmanager
def full_disk_in_one_line(out: Path) -> Iterator[None]:
    """Within, a disk that is full becomes a `Fault` of the run in the folder `out`."""
    try:
        yield
    except OSError as error:
        if error.errno not in DISK_FULL:
            raise
        where = error.filename or out
        raise DiskFull(out, f"{where}: the disk is full ({error.strerror})") from error


@contextmanager
def in_one_line(out: Path) -> Iterator[None]:
    """Within, what gives out while the run in the folder `out` is trained becomes a `Fault`; the checkpoints stay."""
    try:
        with full_disk_in_one_line(out):
            yield
    except (MemoryError, RuntimeError, OSError) as error:
        if not is_out_of_memory(error):
            raise
        raise out_of_memory(out, error=error if is_out_of_gpu_memory(error) else None) from error


def out_of_memory(out: Path, also: str = "", error: BaseException | None = None) -> OutOfMemory:
    """What is said of a run in the folder `out` that cannot go on.

    Args:
        out: The folder.
        also: Tells what has been tried.
        error: That of the GPU; None for the memory of the CPU.
    """
    what = f"{say_out_of_memory(error)}{also}"
    more = "where there is more memory" if error is None else "on a GPU with more memory, or with --device cpu,"
    kept = f"the last checkpoint is whole, and {more} the same command goes on from there"
    none = f"no checkpoint is written yet, and {more} the same command may do"
    return OutOfMemory(
        f"{out}: {what}; smaller photographs (--longest, --scale) or fewer points (a higher "
        "--pretrain.densify.threshold, a lower --primitive.sh-degree) need less, in a folder of their own; "
        f"{kept if has_checkpoint(out) else none}",
        what,
    )
