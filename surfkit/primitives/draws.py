"""Random draws for points, the same ones whatever number of processes they are divided over."""

from __future__ import annotations

import torch
from torch import Tensor


class SharedDraws(torch.Generator):
    """A generator for `total` points, of which this process has some.

    Attributes:
        before: Points of other processes that stand before these.
        total: Points of all processes.
        is_used: Whether something was drawn.
    """

    before: int
    total: int
    is_used: bool


def normals(times: int, count: int, generator: torch.Generator) -> Tensor:
    """(times x count, 3) normal numbers for so many points: one row for each, then the next for each."""
    if not isinstance(generator, SharedDraws):
        return torch.randn(times * count, 3, generator=generator)
    generator.is_used, end = True, generator.before + count
    drawn = torch.randn(times * generator.total, 3, generator=generator).view(times, generator.total, 3)
    return drawn[:, generator.before : end].reshape(-1, 3)
