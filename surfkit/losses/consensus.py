"""What holds the copies of a point together that several blocks optimise (DOGS, Chen and Lee 2024)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.schedule import StepCount, Steps
from surfkit.losses.base import Regularizer, RegularizerInput
from surfkit.raster.api import Splats

STRONG = ("means", "quats", "sh_rest")
"""Raw parameters that are held together strongly, as in the paper."""


@dataclass(frozen=True)
class Consensus(Regularizer):
    """Blocks agree on the points that they have in common, by ADMM (DOGS, Chen and Lee 2024; also called DoGaussian).

    Blocks are tuned in rounds of `every` steps. At the end of each, z is the mean of all copies x of a point, and each
    block adds `relaxation` (x - z) to its sum u of what was left over. From the second round on the term is half of
    rho times the mean over all common points of the mean square of x + u - z, summed over the raw parameters. The
    merged model has the mean of all copies. For `tune.regularizers` of a recipe with blocks that adds and removes no
    points there.
    """

    every: Annotated[int, StepCount(floor=20)] = 200
    """Steps of a round; a run that is scaled to fewer steps has rounds of 20 or more."""

    strong: float = 1e5
    """rho times the number of common points to begin with, for positions, rotations and harmonics above degree 0."""

    weak: float = 1e4
    """The same for all other parameters."""

    relaxation: float = 1.5
    """How much of the differences is added up; ADMM converges on convex problems below 1.618."""

    balance: float = 10.0
    """rho is doubled where the differences between copies are more than so many times rho times the change of their
    mean, and halved where they are less than one over so many."""

    balance_until: Steps = 2_000
    """Last step in which it is."""

    def __post_init__(self) -> None:
        for name in ("strong", "weak"):
            if not 0 < getattr(self, name) < float("inf"):
                raise BadInput(f"consensus.{name} is {getattr(self, name)}; it must be more than 0")
        if self.every < 1 or self.balance_until < 0:
            raise BadInput(
                f"consensus.every {self.every}, balance_until {self.balance_until}: give every >= 1, the other >= 0"
            )
        if not 0 < self.relaxation < 2:
            raise BadInput(f"consensus.relaxation is {self.relaxation}; it must lie between 0 and 2")
        if not self.balance > 1:
            raise BadInput(f"consensus.balance is {self.balance}; it must be more than 1")

    def begins_with(self, name: str) -> float:
        """rho of a raw parameter, times the number of common points."""
        return self.strong if name in STRONG else self.weak

    def weight_at(self, index: int, steps: int) -> float:
        """See `Regularizer.weight_at`."""
        return 1.0

    def __call__(self, splats: Splats) -> Tensor:
        """See `Regularizer.__call__`; splats alone have no copies."""
        return 0 * splats.opacities.sum()

    def in_step(self, splats: Splats, given: RegularizerInput) -> Tensor:
        """See `Regularizer.in_step`; 0 for points that no other block has, and as long as there was no round."""
        total = self(splats)
        for name, value in given.params.items():
            rho = given.stat(column("rho", name))
            if value.numel() and bool(rho.any()):
                u, z = (given.stat(column(what, name), *value.shape[1:]) for what in ("u", "z"))
                gaps = (value + u - z).reshape(len(value), -1)
                total = total + (rho * gaps.square().mean(1)).sum() / 2
        return total


def column(what: str, name: str) -> str:
    """Name of the column that is kept with the points: "rho", over the number of common points, "u" or "z"."""
    return f"consensus.{what}.{name}"
