"""LightGaussian (Fan et al. 2024): the same pictures from fewer points and smaller colours, as CityGaussian does it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import torch

from surfkit.core.check import BadInput
from surfkit.core.registry import name_of
from surfkit.core.schedule import LearningRate
from surfkit.densify.prune import PruneByImportance
from surfkit.primitives.base import Primitive
from surfkit.primitives.columns import RATES
from surfkit.primitives.points import Columns
from surfkit.scene.scene import View
from surfkit.train.refine.base import Refine
from surfkit.train.stage import Stage


def slowing(rates: dict[str, float], to: float) -> dict[str, LearningRate]:
    """Rates that fall to a share of themselves, in three digits."""
    return {
        name: LearningRate(rate, float(f"{rate * to:.3g}")) if rate else LearningRate(0.0)
        for name, rate in rates.items()
    }


STARTS = {name: rate.start for name, rate in RATES.items()}
# CityGaussian's: all rates fall by 5 % every 400 steps of recovery and by 10 % every 500 of distillation; positions
# hardly move, and their rate goes on falling from one to the other.
RECOVERY = slowing(STARTS | {"scales": 7.5e-5}, 0.95**75) | {"means": LearningRate(3e-7, 3e-9)}
DISTILLATION = slowing(STARTS | {"scales": 7.5e-5, "opacities": 0.0}, 0.9**20) | {"means": LearningRate(9.5e-9, 3e-9)}

MAX_COPIES = 1000
"""Of each camera."""


@dataclass(frozen=True)
class PruneAndRecover(Refine):
    """Drop the points of least importance, then optimise the others."""

    stage: Stage = field(
        default_factory=lambda: Stage(densify=None, prune=(PruneByImportance(at=(0,), ratio=0.5),), rates=RECOVERY)
    )
    """The optimisation, with what it drops."""


@dataclass(frozen=True)
class DistilSH(Refine):
    """Lower the degree of the spherical harmonics, and learn from renders of the model before, by more cameras than the
    photographs have."""

    taught: ClassVar[bool] = True

    stage: Stage = field(default_factory=lambda: Stage(steps=10_000, densify=None, rates=DISTILLATION))
    """The optimisation."""

    sh_degree: int = 2
    """Highest degree of the harmonics that are left."""

    jitter: float = 0.01
    """Cameras stand beside those of the photographs by so much along each axis: the standard deviation, as a share of
    the scene extent."""

    copies: int = 4
    """Places beside each photograph."""

    def __post_init__(self) -> None:
        if self.sh_degree not in range(4):
            raise BadInput(f"distil.sh_degree is {self.sh_degree}; it must be 0, 1, 2 or 3")
        if self.jitter < 0 or not 1 <= self.copies <= MAX_COPIES:
            raise BadInput(f"distil.jitter {self.jitter}, copies {self.copies}: give 0 or more, and 1 to {MAX_COPIES}")

    def primitive(self, primitive: Primitive) -> Primitive:
        """The same with fewer harmonics."""
        return replace(primitive, sh_degree=min(self.sh_degree, primitive.sh_degree))

    def refuse_unfit(self, primitive: Primitive) -> None:
        """See `Refine.refuse_unfit`."""
        if "sh_rest" not in primitive.columns():
            raise BadInput(
                f"distil cuts the column sh_rest, which primitive {name_of(primitive)} does not have; leave it out "
                "(refine.N:none), or choose another primitive"
            )

    def params(self, params: Columns) -> Columns:
        """Without the higher harmonics."""
        kept = (self.sh_degree + 1) ** 2 - 1
        return params | {"sh_rest": params["sh_rest"][:, :kept].clone()}

    def views(self, views: Sequence[View], seed: int) -> tuple[View, ...]:
        """Each camera `copies` times, moved without being turned."""
        generator = torch.Generator().manual_seed(seed)
        shifts = self.jitter * torch.randn(self.copies, len(views), 3, generator=generator, dtype=torch.float64)
        return tuple(beside(view, shift) for row in shifts for view, shift in zip(views, row, strict=True))


def beside(view: View, shift: torch.Tensor) -> View:
    """A view whose camera stands elsewhere by `shift`, (3,) local units."""
    pose = view.camera.world_to_camera.clone()
    pose[:3, 3] -= pose[:3, :3] @ shift
    return replace(view, camera=replace(view.camera, world_to_camera=pose))
