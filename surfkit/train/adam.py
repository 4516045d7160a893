"""Adam (Kingma and Ba 2015), over the columns of `Points`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

import torch
from torch import Tensor

from surfkit.primitives.points import Columns, Points
from surfkit.raster import native
from surfkit.raster.nvrtc.cuda_source import CudaSource
from surfkit.raster.nvrtc.modules import Kernels, kernels
from surfkit.train.moments import SHORT, dithered, is_short
from surfkit.train.optimizer import Optimizer, OptimizerInput

BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-15
ADAM_SOURCE = CudaSource(Path(__file__).parent / "cuda" / "adam.cu")
VALUES_PER_BLOCK = 1024
"""Values that a block of the kernel updates."""
VALUES_TOGETHER = 2**21
"""Values that are copied together where the kernels cannot take the tensors as they are."""
UPDATED = "updated"
"""Column of `Points.stats`: the last step in which a point was updated, where some are updated alone."""


@dataclass(frozen=True)
class Adam(Optimizer):
    """Adam for all points: those out of view move on by momentum, as in 3DGS."""

    divides: ClassVar[bool] = True

    moments: Literal["float32", "bfloat16"] = "float32"
    """How the two moments of each parameter are kept. bfloat16 takes a third less memory for parameters and moments;
    the length of a step is then 2.5 % off at random."""

    def moment_type(self) -> torch.dtype:
        """See `Optimizer.moment_type`."""
        return SHORT if self.moments == "bfloat16" else torch.float32

    def step(self, points: Points, grads: Columns, given: OptimizerInput) -> None:
        """See `Optimizer.step`."""
        adam_step(points, grads, given.rates, given.index, given.rows)


@dataclass(frozen=True)
class AdamInView(Adam):
    """Adam for the points that the view may show: a step then costs what its view shows, whatever the size of the
    scene (but for what policies look at). Stages with regularizers, steps with a second view, and primitives that draw
    themselves or have parameters that belong to no point always update all."""

    in_view: ClassVar[bool] = True


@torch.no_grad()
def adam_step(
    points: Points, grads: Columns, rates: Mapping[str, float], index: int, rows: Tensor | None = None
) -> None:
    """Take a step of Adam on every column that has a gradient, in place.

    With `rows`, the other points keep values and moments. The second moments of a point fade in the steps in which it
    is not among these too, as if its gradient were 0 then, so that a gradient moves a point that few views show about
    as far as in steps for all points. What momentum adds between is left out; it comes with the next gradients. From
    one update to the next they fade no further than the first moments do: old momentum would move points ever faster.

    Args:
        points: N of them.
        grads: (N, ...) by column, or (R, ...) of the rows.
        rates: Learning rates.
        index: The step, from 1.
        rows: (R,) int64, different points that alone are updated; None for all.
    """
    values = points.all_params()
    if rows is None and UPDATED in points.stats:
        rows = torch.arange(len(points), device=values["means"].device)
    if rows is None:
        for name, grad in grads.items():
            update(values[name], grad, points.exp_avg[name], points.exp_avg_sq[name], rates[name], index)
        return
    if UPDATED not in points.stats:
        points.stat(UPDATED).fill_(index - 1)
    updated = points.stats[UPDATED]
    kept = (BETA2 ** (index - 1 - updated[rows])).clamp(BETA1, 1)
    for name, grad in grads.items():
        moments = points.exp_avg[name], points.exp_avg_sq[name]
        update_rows(values[name], rows, kept, grad, *moments, rates[name], index)
    updated[rows] = index


def update(
    value: Tensor, grad: Tensor, exp_avg: Tensor, exp_avg_sq: Tensor, rate: float, index: int, first: int = 0
) -> None:
    """Take one step of Adam on a tensor (N, ...) and its moments of the same shape, in place.

    Args:
        value: (N, ...).
        grad: (N, ...).
        exp_avg: (N, ...), float32 or, as `exp_avg_sq`, bfloat16 (`train.moments`).
        exp_avg_sq: (N, ...).
        rate: The learning rate.
        index: The step, from 1.
        first: Place in its column of the first value, for moments in 16 bits.
    """
    width = math.prod(value.shape[1:])
    if grad.numel() > VALUES_TOGETHER and not grad.is_contiguous():
        for some in _pieces(len(grad), width):  # copies of some rows at a time hold less than one of all
            update(value[some], grad[some], exp_avg[some], exp_avg_sq[some], rate, index, first + some.start * width)
        return
    tensors = value, grad.contiguous(), exp_avg, exp_avg_sq
    if all(map(_is_gpu, tensors)):
        launch_update(kernels(ADAM_SOURCE, value.device), *tensors, rate, index, first)
        return
    is_compiled = native.module() is not None and all(map(_is_plain, tensors))
    if is_short(exp_avg) and is_compiled:
        _update_short(value, None, None, *tensors[1:], rate, index, first)
        return
    if is_short(exp_avg):
        for some in _pieces(len(grad), width):
            moments = exp_avg[some].float(), exp_avg_sq[some].float()
            update(value[some], grad[some], *moments, rate, index)
            exp_avg[some] = moments[0].to(SHORT)
            places = first + some.start * width + torch.arange(moments[1].numel(), device=value.device)
            exp_avg_sq[some] = dithered(moments[1].flatten(), places, index).view_as(moments[1])
        return
    rate, correction = _corrected(rate, index)
    if is_compiled:
        native.kernels().adam(*tensors, rate, BETA1, BETA2, correction, EPSILON, torch.get_num_threads())
        return
    exp_avg.lerp_(grad, 1 - BETA1)
    exp_avg_sq.mul_(BETA2).addcmul_(grad, grad, value=1 - BETA2)
    value.addcdiv_(exp_avg, exp_avg_sq.sqrt().mul_(correction).add_(EPSILON), value=-rate)


def update_rows(
    value: Tensor,
    rows: Tensor,
    kept: Tensor,
    grad: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    rate: float,
    index: int,
) -> None:
    """What `update` does, on some rows of a tensor (N, ...) and its moments alone.

    Args:
        value: (N, ...).
        rows: (R,) int64, different ones.
        kept: (R,) what is left of the second moments before this step.
        grad: (R, ...) of these rows.
        exp_avg: (N, ...).
        exp_avg_sq: (N, ...).
        rate: The learning rate.
        index: From 1.
    """
    grad = grad.contiguous()
    tensors = (value, kept, grad, exp_avg, exp_avg_sq)
    if all(map(_is_gpu, tensors)):
        launch_update_rows(
            kernels(ADAM_SOURCE, value.device), value, rows, kept, grad, exp_avg, exp_avg_sq, rate, index
        )
        return
    if native.module() is not None and all(map(_is_plain, tensors)):
        if is_short(exp_avg):
            _update_short(value, rows, kept, grad, exp_avg, exp_avg_sq, rate, index)
            return
        rate, correction = _corrected(rate, index)
        numbers = rate, BETA1, BETA2, correction, EPSILON, torch.get_num_threads()
        native.kernels().adam_rows(value, rows, kept, grad, exp_avg, exp_avg_sq, *numbers)
        return
    width = math.prod(value.shape[1:])
    if grad.numel() > VALUES_TOGETHER:
        for part in _pieces(len(rows), width):
            update_rows(value, rows[part], kept[part], grad[part], exp_avg, exp_avg_sq, rate, index)
        return
    some, first, second = (tensor.index_select(0, rows).float() for tensor in (value, exp_avg, exp_avg_sq))
    second *= kept.view(-1, *[1] * (value.dim() - 1))
    update(some, grad, first, second, rate, index)
    value[rows], exp_avg[rows] = some, first.to(exp_avg.dtype)
    if is_short(exp_avg_sq):
        places = (rows[:, None] * width + torch.arange(width, device=rows.device)).flatten()
        second = dithered(second.view(-1), places, index).view_as(second)
    exp_avg_sq[rows] = second


def launch_update(
    on: Kernels,
    value: Tensor,
    grad: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    rate: float,
    index: int,
    first: int = 0,
) -> None:
    """What `update` does to tensors of one shape (N, ...), by the kernel of adam.cu."""
    name, moments = _kernel("adam", exp_avg, exp_avg_sq)
    on.launch(name, _blocks(grad), 256, value, grad, *moments, first, *_numbers(rate, index))


def launch_update_rows(
    on: Kernels,
    value: Tensor,
    rows: Tensor,
    kept: Tensor,
    grad: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    rate: float,
    index: int,
) -> None:
    """What `update_rows` does to (R,) rows of tensors (N, ...), by the kernel of adam.cu."""
    wide = grad[:1].numel()
    name, moments = _kernel("adam_rows", exp_avg, exp_avg_sq)
    on.launch(name, _blocks(grad), 256, value, rows, kept, grad, *moments, wide, *_numbers(rate, index))


def _update_short(
    value: Tensor,
    rows: Tensor | None,
    kept: Tensor | None,
    grad: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    rate: float,
    index: int,
    first: int = 0,
) -> None:
    """`update` or, with rows, `update_rows` with moments in 16 bits, by the compiled kernel."""
    rate, correction = _corrected(rate, index)
    numbers = first, index, rate, BETA1, BETA2, correction, EPSILON, torch.get_num_threads()
    moments = exp_avg.view(torch.uint16), exp_avg_sq.view(torch.uint16)
    native.kernels().adam_short(value, rows, kept, grad, *moments, *numbers)


def _pieces(rows: int, width: int) -> Iterator[slice]:
    """Rows of so many values each, some at a time."""
    many = max(1, VALUES_TOGETHER // width)
    return (slice(at, at + many) for at in range(0, rows, many))


def _kernel(name: str, *moments: Tensor) -> tuple[str, list[Tensor]]:
    """The kernel for moments of their type, and these as it takes them."""
    if is_short(moments[0]):
        return f"{name}_16", [moment.view(torch.int16) for moment in moments]
    return name, list(moments)


def _blocks(grad: Tensor) -> int:
    return (grad.numel() + VALUES_PER_BLOCK - 1) // VALUES_PER_BLOCK


def _numbers(rate: float, index: int) -> tuple[float, ...]:
    rate, correction = _corrected(rate, index)
    return rate, 1 - BETA1, 1 - BETA2, correction, EPSILON, index


def _corrected(rate: float, index: int) -> tuple[float, float]:
    """The learning rate and the factor of the root of the second moment, corrected for moments that began at 0."""
    return rate / (1 - BETA1**index), (1 - BETA2**index) ** -0.5


def _is_gpu(tensor: Tensor) -> bool:
    return tensor.device.type == "cuda" and tensor.dtype in (torch.float32, SHORT) and tensor.is_contiguous()


def _is_plain(tensor: Tensor) -> bool:
    return tensor.device.type == "cpu" and tensor.dtype in (torch.float32, SHORT) and tensor.is_contiguous()
