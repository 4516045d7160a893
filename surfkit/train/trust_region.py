"""Steps of second order, within a trust region of each splat."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.schedule import log_linear
from surfkit.primitives.points import Columns, Points
from surfkit.raster.api import Maps, Splats
from surfkit.scene.rotations import rotations
from surfkit.train.optimizer import Optimizer, OptimizerInput

GRADIENT_KEPT, CURVATURE_KEPT = 0.9, 0.95
"""Shares of the running means of gradients and of curvature that stay, once there have been some."""
DAMPING = 0.1
"""Share of the mean curvature of all points that is added to that of each."""
THINNEST = 0.1
"""Axes shorter than this share of a splat's longest count as so long; discs have no thickness at all."""
MOST_TURN = math.sin(math.radians(30))
"""Sine of the largest angle by which a splat may turn in a step, however round it is."""
MOST_LOGIT = 8.0
"""Opacities stay between those of this logit and its opposite where they change."""
SH0 = 0.28209479177387814
"""The spherical harmonic of degree 0."""
VIEW_DEPENDENT = 1 / 20
"""Coefficients of higher degree, of which a colour adds up many, may change by this share, as their learning rate is
in 3DGS."""
TINY = 1e-30


@dataclass(frozen=True)
class TrustRegion(Optimizer):
    """Newton steps by the diagonal of the Gauss-Newton matrix, as far as no splat changes too much in one of its
    parameters (after 3DGS2-TR, Hsiao et al. 2026). For the points that the view may show. Learning rates are not used,
    but a parameter with a rate of 0 stays.

    From the paper: the diagonal alone, by Hutchinson's method, and a bound of the squared Hellinger distance by which a
    step changes a splat, for each parameter by itself. What follows is our own. Each pixel has the curvature of a
    squared error whose gradient is that of the absolute one at the mean error of the view; the diagonal of J^T B J is
    then the mean of (J^T B^1/2 z)^2 over random signs z. The distances are those of Gaussians for positions, scales and
    rotations, and for opacities those of a ray that is stopped or not. Colours may change as far as an opacity of one
    half.
    """

    in_view: ClassVar[bool] = True
    pulls: ClassVar[bool] = True

    radius: float = 1e-4
    """Squared Hellinger distance by which a parameter may change a splat in the first step."""

    last_radius: float = 1e-5
    """The same in the last step; between, it falls along a straight line in the logarithm."""

    relaxation: float = 0.3
    """Share of the Newton step that is taken: many splats stand for one pixel, and each would make up for all of its
    error."""

    probe_every: int = 4
    """Steps between estimates of the curvature; each takes another backward pass."""

    def __post_init__(self) -> None:
        if not (0 < self.radius <= 0.1 and 0 < self.last_radius <= 0.1):
            raise BadInput(
                f"trust-region.radius is {self.radius:g}, last_radius {self.last_radius:g}; give above 0, up to 0.1"
            )
        if not 0 < self.relaxation <= 1:
            raise BadInput(f"trust-region.relaxation is {self.relaxation:g}; give above 0, up to 1")
        if self.probe_every < 1:
            raise BadInput(f"trust-region.probe_every is {self.probe_every}; it must be 1 or more steps")

    @torch.no_grad()
    def step(self, points: Points, grads: Columns, given: OptimizerInput) -> None:
        """See `Optimizer.step`.

        Raises:
            BadInput: The points have other parameters than those of 3DGS.
        """
        if strange := sorted(set(grads) - set(BOUNDS)):
            raise BadInput(
                f"optimizer: trust-region knows the parameters {', '.join(BOUNDS)}, and not {strange[0]!r} of this "
                "primitive; choose optimizer:adam, or another primitive"
            )
        rows = torch.arange(len(points)).to(given.splats.means.device) if given.rows is None else given.rows
        if (given.index - 1) % self.probe_every == 0:
            known = _counted(points, "trust-region/probes", rows)
            for name, square in probe(given).items():
                before = points.exp_avg_sq[name]
                first = square.mean(0, keepdim=True).expand_as(square)  # one probe says little: all points together
                before[rows] = torch.where(_each(known == 1, square), first, before[rows])
                _blend(before, rows, square, 1 / (known + 1), CURVATURE_KEPT)
        known = _counted(points, "trust-region/steps", rows)
        radius = log_linear(self.radius, self.last_radius, given.index / given.steps)
        for name, grad in grads.items():
            if given.rates[name] == 0:
                continue
            mean = _blend(points.exp_avg[name], rows, grad, 1 / known, GRADIENT_KEPT)
            curvature = points.exp_avg_sq[name][rows]
            damped = curvature + DAMPING * curvature.mean(0, keepdim=True) + TINY
            value = points.params[name]
            old = value[rows]
            value[rows] = BOUNDS[name](old, -self.relaxation * mean / damped, given.splats, radius)


def probe(given: OptimizerInput) -> Columns:
    """One sample of the diagonal of the Gauss-Newton matrix by parameter, (R, ...); its mean over seeds is exact."""
    color, photo, mask = given.maps.need("color"), given.target.photo, given.target.mask
    counts = torch.ones_like(color) if mask is None else mask.to(color).expand_as(color)
    total = counts.sum().clamp_min(1)
    error = ((color - photo).abs() * counts).sum() / total
    weight = counts / (total * error.clamp_min(1e-3))
    draw = torch.Generator().manual_seed(given.seed)
    signs = (2 * torch.randint(0, 2, color.shape, generator=draw) - 1).to(color)
    with torch.enable_grad():
        pulled = given.pull(Maps(color=signs * weight.sqrt()))
    return {name: grad * grad for name, grad in pulled.items()}


def shifted(old: Tensor, change: Tensor, splats: Splats, radius: float) -> Tensor:
    """(R, 3) positions: 1 - exp(-d^2 / 8) for a shift of d standard deviations."""
    deviations = torch.einsum("nji,nj->ni", rotations(splats.quats), change) / axes(splats)
    return old + _shortened(change, deviations.norm(dim=1, keepdim=True), math.sqrt(-8 * math.log1p(-radius)))


def stretched(old: Tensor, change: Tensor, splats: Splats, radius: float) -> Tensor:
    """(R, axes) logarithms of scales: 1 - cosh(x)^-1/2 for one that changes by x."""
    most = math.acosh((1 - radius) ** -2)
    return old + change.clamp(-most, most)


def turned(old: Tensor, change: Tensor, splats: Splats, radius: float) -> Tensor:
    """(R, 4) quaternions: 1 - (1 + k sin^2(t) / 4)^-1/2 for an angle of t between two axes, k = (a / b - b / a)^2.

    The axes are the longest and the shortest, whichever way the splat turns.
    """
    length, sigma = old.norm(dim=1, keepdim=True), axes(splats)
    unit = old / length.clamp_min(TINY)
    across = change - (change * unit).sum(1, keepdim=True) * unit  # the rest changes the length alone
    ratio = sigma.amax(1, keepdim=True) / sigma.amin(1, keepdim=True)
    sine = (2 * math.sqrt((1 - radius) ** -2 - 1) / (ratio - 1 / ratio).clamp_min(TINY)).clamp_max(MOST_TURN)
    return old + _shortened(across, across.norm(dim=1, keepdim=True), length * (sine.asin() / 2).tan())


def faded(old: Tensor, change: Tensor, splats: Splats, radius: float) -> Tensor:
    """(R,) logits of opacities: 1 - cos(u - v) for opacities sin^2 u and sin^2 v."""
    most = math.acos(1 - radius)
    begin, end = ((x.clamp(-MOST_LOGIT, MOST_LOGIT) / 2).exp().atan() for x in (old, old + change))
    lowest = math.atan(math.exp(-MOST_LOGIT / 2))
    after = (begin + (end - begin).clamp(-most, most)).clamp(lowest, math.pi / 2 - lowest)
    return torch.where(change == 0, old, 2 * after.tan().log())


def tinted(old: Tensor, change: Tensor, splats: Splats, radius: float) -> Tensor:
    """(R, 1, 3) coefficients of degree 0: a colour changes as far as an opacity of one half may."""
    most = math.acos(1 - radius) / SH0
    return old + change.clamp(-most, most)


def tinted_by_direction(old: Tensor, change: Tensor, splats: Splats, radius: float) -> Tensor:
    """(R, K - 1, 3) coefficients of higher degree."""
    most = math.acos(1 - radius) / SH0 * VIEW_DEPENDENT
    return old + change.clamp(-most, most)


BOUNDS: dict[str, Callable[[Tensor, Tensor, Splats, float], Tensor]] = {
    "means": shifted,
    "scales": stretched,
    "quats": turned,
    "opacities": faded,
    "sh0": tinted,
    "sh_rest": tinted_by_direction,
}
"""By parameter: the raw values after a change, of R splats as they are drawn, within a squared Hellinger distance."""


def axes(splats: Splats) -> Tensor:
    """(R, 3) standard deviations along the axes, none of them too short."""
    scales = splats.scales
    longest = scales.amax(1, keepdim=True)
    missing = longest.new_zeros(len(scales), 3 - scales.shape[1])
    return torch.maximum(torch.cat([scales, missing], 1), THINNEST * longest)


def _shortened(change: Tensor, size: Tensor, most: Tensor | float) -> Tensor:
    """Changes (R, C) whose (R, 1) sizes are `most` at most."""
    return change * (most / size.clamp_min(TINY)).clamp_max(1)


def _counted(points: Points, name: str, rows: Tensor) -> Tensor:
    """(R,) how often these points have been here, this time included."""
    counts = points.stat(name)
    counts[rows] += 1
    return counts[rows]


def _blend(means: Tensor, rows: Tensor, value: Tensor, share: Tensor, kept: float) -> Tensor:
    """(R, ...) the running means of some rows with new values, (R, ...), of which they take (R,) shares at first."""
    means[rows] = torch.lerp(means[rows], value, _each(share.clamp_min(1 - kept), value))
    return means[rows]


def _each(values: Tensor, like: Tensor) -> Tensor:
    """(R,) as (R, 1, ...), with as many axes as another."""
    return values.view(-1, *[1] * (like.dim() - 1))
