"""Adam's moments in 16 bits: of the 12 bytes that a value takes with its moments, 4 are saved.

Both are kept as bfloat16, the upper half of a float32, so that nothing overflows. The first moment changes by a tenth
in a step and is rounded to nearest. The second changes by a thousandth, which is less than the spacing of such numbers:
rounded to nearest it would stand still. It is rounded up or down at random, in the mean to itself. What chance adds to
it step by step fades as old gradients do: its standard deviation comes to 5 % of the moment, 2.5 % of a step's length.
The numbers are not drawn but made of the value's place and the step: a run that goes on has the same ones.
"""

from __future__ import annotations

import torch
from torch import Tensor

SHORT = torch.bfloat16
"""The type of moments in 16 bits; cuda/adam.cu has the same arithmetic."""
MASK = 0xFFFFFFFF


def is_short(moment: Tensor) -> bool:
    """Whether a moment, (N, ...), is kept in 16 bits."""
    return moment.dtype == SHORT


def dithered(second: Tensor, places: Tensor, step: int) -> Tensor:
    """(M,) bfloat16 of (M,) float32 second moments, each rounded up or down so that the mean over steps stays.

    Args:
        second: 0 or more.
        places: (M,) int64, of the values in their column.
        step: From 1.
    """
    bits = second.contiguous().view(torch.int32) + mixed(places, step)
    return (bits >> 16).to(torch.int16).view(SHORT)


def mixed(places: Tensor, step: int) -> Tensor:
    """(M,) int32 in [0, 2^16): numbers without a pattern, made of places and a step (multiply, shift and xor, with the
    multipliers that C. Wellons found best for 32 bits)."""
    h = (places * 0x9E3779B1 + step * 0x85EBCA77) & MASK
    h = ((h ^ h >> 16) * 0x7FEB352D) & MASK
    h = ((h ^ h >> 15) * 0x846CA68B) & MASK
    return (h >> 16).to(torch.int32)
