"""The loss of MetroGS that surfkit does not have: large points cost."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from torch import Tensor

from surfkit.plugin import BadInput, Regularizer, Splats


@dataclass(frozen=True)
class LargeScale(Regularizer):
    """Mean, over the points that the view shows, of how much their largest scale exceeds a limit (MetroGS, section
    4.3.1, eq. 6).

    L_s = 1 / |M| sum over i in M of max(max(s_i) - tau_s, eps). With eps 0 here: a constant moves no point.
    """

    only_seen: ClassVar[bool] = True

    weight: float = 0.1
    """Loss weight, for scales as a share of the scene extent; the paper has 0.1, and 0.001 on Mill-19, for scales in
    the units of its data."""

    limit: float = 0.01
    """Scale up to which a point costs nothing, as a share of the scene extent (tau_s). The paper does not state it;
    this is the size from which on ADC splits."""

    def __post_init__(self) -> None:
        for name in ("weight", "limit"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise BadInput(f"regularizer large-scale: {name} is {getattr(self, name):g}; it must be 0 or more")

    def weight_at(self, index: int, steps: int) -> float:
        return self.weight

    def __call__(self, splats: Splats) -> Tensor:
        return (splats.scales.amax(-1) - self.limit).clamp_min(0).sum() / max(1, len(splats))
