"""Points that are drawn as codes while they are trained (CompGS, Navaneet et al. 2024)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import torch
from torch import Tensor

from surfkit.plugin import (
    Adam,
    BadInput,
    Columns,
    OptimizerInput,
    Points,
    Primitive,
    StepCount,
    Steps,
    kmeans,
    name_of,
    nearest,
)

SIZES = {"sh0": "colors", "sh_rest": "colors", "scales": "shapes", "quats": "shapes"}
"""Raw parameters that are quantised, each by itself, and the setting that says how many codes it has."""
MOST_CODES = 1 << 20
"""Numbers of codes are kept as float32, which has whole numbers up to 2^24."""


@dataclass(frozen=True)
class CodedAdam(Adam):
    """Adam on points that are drawn as codes of k-means (CompGS, Navaneet et al. ECCV 2024, section 3).

    After step `start`, base colours, the other harmonics, scales and rotations of each point are those of the nearest
    of a few thousand codes. A straight-through estimator takes the gradient by what is drawn for that by the parameters
    without codes, and Adam moves these. After each step a code becomes the mean of its points, and every `every` steps,
    up to `until`, each point chooses its code anew, as one iteration of k-means does. Positions and opacities are never
    quantised. The points hold the codes, which policies see, and which are measured and saved; what they differ by is
    kept beside them, and goes with them through edits. New points choose a code at once. A block of a scene has codes
    of its own.

    The paper has 4,096 codes for colours, and 16,384 (CompGS 16K) or 32,768 for shapes. How the first codes are
    found, and whether scales are clustered as logarithms, was not at hand: here k-means of 10 iterations finds them,
    and what is clustered are raw parameters, logarithms of scales, so that differences are relative, and quaternions
    of any length.
    """

    colors: int = 4_096
    """Codes of the base colours, and as many of the other harmonics."""

    shapes: int = 16_384
    """Codes of the scales, and as many of the rotations."""

    start: Steps = 20_000
    """Last step whose points are not codes."""

    until: Steps = 25_000
    """Last step after which points choose other codes."""

    every: Annotated[int, StepCount(floor=20)] = 100
    """Steps between choices; short runs keep at least 20."""

    def __post_init__(self) -> None:
        for name in ("colors", "shapes"):
            if not 1 <= getattr(self, name) <= MOST_CODES:
                raise BadInput(f"optimizer:coded-adam: {name} is {getattr(self, name)}; give 1 to {MOST_CODES}")
        if not 0 <= self.start <= self.until or self.every < 1:
            raise BadInput(
                f"optimizer:coded-adam: start {self.start}, until {self.until}, every {self.every}; give "
                f"0 <= start <= until, and every 1 step or more"
            )

    def refuse_unfit(self, path: str, stage: Any, primitive: Primitive) -> None:
        """See `Optimizer.refuse_unfit`."""
        if self.start >= stage.steps:
            raise BadInput(
                f"{path}.optimizer: coded-adam begins with codes after step {self.start}, and the stage has "
                f"{stage.steps}; lower {path}.optimizer.start"
            )
        if not set(SIZES) & set(primitive.columns()):
            raise BadInput(
                f"{path}.optimizer: coded-adam quantises {', '.join(SIZES)}, and primitive {name_of(primitive)} has "
                f"none of them; choose another primitive, or optimizer:adam"
            )

    @torch.no_grad()
    def step(self, points: Points, grads: Columns, given: OptimizerInput) -> None:
        """See `Optimizer.step`."""
        coded = [name for name in SIZES if name in grads and points.params[name].numel()]  # no harmonics: no codes
        for name in coded:
            if missing(name) in points.stats:
                points.params[name].add_(points.stats[missing(name)])
        super().step(points, grads, given)
        if given.index > self.start:
            for name in coded:
                self._quantise(points, name, given)

    def _quantise(self, points: Points, name: str, given: OptimizerInput) -> None:
        """Put codes in the place of a column, and keep what it differs from them by."""
        column = points.params[name]
        values = column.reshape(len(points), -1)
        number = points.stat(f"compgs/code/{name}")
        old = number.bool()
        if not old.any():
            vectors = values.float().cpu()
            codes = kmeans(vectors, getattr(self, SIZES[name]), seed=given.seed, device=values.device)
            choose(number, values, codes, ~old)
        else:
            due = given.index <= self.until and (given.index - self.start - 1) % self.every == 0
            used = number.unique()  # codes without points are gone
            used = used[used > 0]
            number.copy_(torch.where(old, torch.searchsorted(used, number) + 1, 0))
            choose(number, values, means_of(values, number)[1:], torch.ones_like(old) if due else ~old)
        drawn = means_of(values, number)[number.long()].reshape(column.shape)
        points.stat(missing(name), *column.shape[1:]).copy_(column - drawn)
        column.copy_(drawn)


def missing(name: str) -> str:
    """Name of the column (N, ...) of what the codes of a parameter lack of it."""
    return f"compgs/missing/{name}"


def choose(number: Tensor, values: Tensor, codes: Tensor, which: Tensor) -> None:
    """Let some points, a mask (N,), have the nearest of (K, D) codes: write its place from 1 to (N,) numbers."""
    if bool(which.any()):
        place, _ = nearest(values[which].float().cpu(), codes.float().cpu(), values.device)
        number[which] = place.to(number) + 1


def means_of(values: Tensor, number: Tensor) -> Tensor:
    """(K + 1, D) means of (N, D) values by (N,) numbers of 0 to K, in their type; 0 where there are none."""
    rows, most = number.long(), int(number.max())
    sums = values.new_zeros(most + 1, values.shape[1], dtype=torch.float64).index_add_(0, rows, values.double())
    counts = rows.bincount(minlength=most + 1).clamp_min(1)
    return (sums / counts[:, None]).to(values)
