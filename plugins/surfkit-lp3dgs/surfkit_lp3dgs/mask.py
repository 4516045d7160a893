"""The mask that is learned, and the optimizer that learns it (LP-3DGS, Zhang et al. 2024, section 3.3)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from surfkit.plugin import SIGMOID, Adam, BadInput, Columns, OptimizerInput, Points, Primitive, name_of

MASK, SCORE = "lp3dgs/mask", "lp3dgs/score"
"""Columns (N,): m, and the importance S; 0 of points that have none. The pruner writes them first."""
DRAWN, MISSING = "lp3dgs/drawn", "lp3dgs/missing"
"""Columns (N,): the factor gs of the opacity that a point is drawn with, 0 where it is drawn as it is; and what its
logit lacks of that without a mask."""
FIRST, SECOND, AGE = "lp3dgs/first", "lp3dgs/second", "lp3dgs/age"
"""Columns (N,): the moments of m, and the steps that it has learned."""
LEAST_MASK, LEAST_FACTOR = 1e-3, 1e-6
"""m stays above 0, as its logarithm is taken; opacities stay above 0, as their logits are kept."""
BETA1, BETA2, EPSILON = 0.9, 0.999, 1e-15


def gumbel_sigmoid(product: Tensor, noise: Tensor | float, tau: float) -> Tensor:
    """(N,) gs = 1 / (1 + exp(-(log(m S) + g_0 - g_1) / tau)) (LP-3DGS, eq. gumbel_sigmoid).

    Args:
        product: (N,) m S, 0 or more.
        noise: (N,) g_0 - g_1, of two draws from the Gumbel distribution; 0 for the factor in the middle.
        tau: Temperature, above 0.
    """
    return torch.sigmoid((product.log() + noise) / tau)


def gumbel_difference(count: int, seed: int, like: Tensor) -> Tensor:
    """(count,) differences of two draws from the Gumbel distribution, which have the logistic one; of the type and on
    the device of a tensor. The device does not change the draws."""
    draw = torch.rand(count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.logit(draw.clamp(1e-12, 1 - 1e-12)).to(like)


@dataclass(frozen=True)
class MaskedAdam(Adam):
    """Adam, also of a mask of each point, while `prune:learned-mask` has them learned (LP-3DGS, Zhang et al. 2024).

    The opacity that is drawn is o gs(m S) then, with the mask m and the importance S of the point, and gs the Gumbel
    sigmoid, whose noise is drawn anew for each step (section 3.3, eqs. gumbel_sigmoid and apply_mask).

    The loss gets sparsity times the mean of |m|. Gradients by o and by m follow from that by the logit of what is
    drawn. Meanwhile the points hold the masked opacities, so that all that looks at them sees what is drawn; what is
    missing is kept beside them, and comes back when the learning ends. In all other steps this is `adam`.

    The learning rate of m is not in the paper; at the default m can fall from 1 to 0 in 100 steps, or rise to 6 in 500.
    """

    tau: float = 0.5
    """Temperature of the Gumbel sigmoid."""

    sparsity: float = 5e-4
    """Weight of the mean of |m| in the loss (lambda_m)."""

    rate: float = 0.01
    """Learning rate of m."""

    def __post_init__(self) -> None:
        for name in ("tau", "rate"):
            if not 0 < getattr(self, name) < math.inf:
                raise BadInput(f"optimizer:masked-adam: {name} is {getattr(self, name):g}; it must be above 0")
        if not 0 <= self.sparsity < math.inf:
            raise BadInput(f"optimizer:masked-adam: sparsity is {self.sparsity:g}; it must be 0 or more")

    def refuse_unfit(self, path: str, stage: Any, primitive: Primitive) -> None:
        """See `Optimizer.refuse_unfit`."""
        column = primitive.columns().get("opacities")
        if column is None or column.shape != () or column.activation is not SIGMOID:
            raise BadInput(
                f"{path}.optimizer:masked-adam masks logits of opacities, one of each point, and primitive "
                f"{name_of(primitive)} has none; choose another primitive, or optimizer:adam"
            )
        if not any(name_of(prune) == "learned-mask" for prune in stage.prune):
            raise BadInput(
                f"{path}.optimizer:masked-adam learns no mask without the pruner that says when; add "
                f"{path}.prune.{len(stage.prune)}:learned-mask, or choose optimizer:adam"
            )

    @torch.no_grad()
    def step(self, points: Points, grads: Columns, given: OptimizerInput) -> None:
        """See `Optimizer.step`."""
        score, drawn = points.stats.get(SCORE), points.stats.get(DRAWN)
        if drawn is not None and bool(drawn.any()):
            grads = grads | self._unmasked(points, drawn, grads["opacities"], given.index)
        super().step(points, grads, given)
        if score is not None and bool(score.any()):
            _put_mask(points, self._drawn_anew(points, score, given.seed))

    def _unmasked(self, points: Points, drawn: Tensor, grad: Tensor, index: int) -> Columns:
        """Put back what the mask took from the opacities, and let it learn; the gradient by the logits without it.

        With the drawn opacity o' = o gs and its logit r', dL/dr = dL/dr' (1 - o) / (1 - o') and
        dL/dm = dL/dr' (1 - gs) / ((1 - o') tau m).
        """
        masked, mask, raw = drawn > 0, points.stat(MASK), points.params["opacities"]
        seen = 1 - torch.sigmoid(raw)
        raw.add_(points.stat(MISSING))
        points.stat(MISSING).zero_()
        by_mask = grad * (1 - drawn) / (seen * self.tau * mask.clamp_min(LEAST_MASK))
        by_mask += self.sparsity / masked.sum()
        self._learn(points, torch.where(masked, by_mask, 0), masked)
        found = torch.where(masked, grad * (1 - torch.sigmoid(raw)) / seen, grad)
        drawn.zero_()
        return {"opacities": found}

    def _learn(self, points: Points, grad: Tensor, masked: Tensor) -> None:
        """A step of Adam on the masks of some points, each by the number of its own steps."""
        mask, first, second, age = (points.stat(name) for name in (MASK, FIRST, SECOND, AGE))
        age += masked
        first.copy_(torch.where(masked, BETA1 * first + (1 - BETA1) * grad, first))
        second.copy_(torch.where(masked, BETA2 * second + (1 - BETA2) * grad**2, second))
        least = age.clamp_min(1)
        mean, size = first / (1 - BETA1**least), (second / (1 - BETA2**least)).sqrt()
        moved = (mask - self.rate * mean / (size + EPSILON)).clamp_min(LEAST_MASK)
        mask.copy_(torch.where(masked, moved, mask))

    def _drawn_anew(self, points: Points, score: Tensor, seed: int) -> Tensor:
        """(N,) the factors of the coming step; 0 for points without importance, which are drawn as they are."""
        noise = gumbel_difference(len(points), seed, score)
        factor = gumbel_sigmoid(points.stat(MASK) * score, noise, self.tau).clamp(LEAST_FACTOR, 1)
        return torch.where(score > 0, factor, 0)


def _put_mask(points: Points, factor: Tensor) -> None:
    """Multiply opacities by (N,) factors, and keep what their logits lack; a factor of 0 leaves a point as it is."""
    raw, masked = points.params["opacities"], factor > 0
    opacity = (torch.sigmoid(raw) * factor).clamp_min(LEAST_FACTOR)
    logits = torch.where(masked, torch.logit(opacity, 1e-7), raw)
    points.stat(MISSING).copy_(raw - logits)
    raw.copy_(logits)
    points.stat(DRAWN).copy_(factor)
