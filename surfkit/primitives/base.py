"""What a kind of primitive decides: how points begin, what splats they are, and how one becomes two."""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.registry import Component
from surfkit.export.ply import SplatTable
from surfkit.primitives.points import Columns, Edit, Points
from surfkit.raster.api import Splats
from surfkit.scene.scene import Cloud

SHRINK = 1.6
"""A child of a split is smaller than its parent by this factor."""


@dataclass(frozen=True)
class Primitive(Component):
    """A kind of splat. Its raw parameters are columns of `Points`.

    Columns: means (N, 3) local units; scales (N, 2 or 3) natural log; quats (N, 4) wxyz of any length; opacities (N,)
    logit; sh0 (N, 1, 3); sh_rest (N, K - 1, 3) with K = (sh_degree + 1)^2.
    """

    sh_degree: int = 3
    """Highest degree of the spherical harmonics of a colour, 0 to 3; 0 is one colour for all directions."""

    def __post_init__(self) -> None:
        if self.sh_degree not in range(4):
            raise BadInput(f"primitive.sh_degree is {self.sh_degree}; it must be 0, 1, 2 or 3")

    @abstractmethod
    def init(self, cloud: Cloud, generator: torch.Generator) -> Columns:
        """Raw parameters of one point per cloud point."""

    @abstractmethod
    def activate(self, params: Columns, degree: int) -> Splats:
        """Activated splats, with the autograd graph to `params`, using harmonics up to `degree`."""

    @abstractmethod
    def split(self, params: Columns, generator: torch.Generator) -> Columns:
        """Raw parameters of the children of M points: 2 M rows, the first children of all, then the second."""


def harmonics(params: Columns, degree: int) -> Tensor:
    """(N, (degree + 1)^2, 3) coefficients in use."""
    if degree == 0:
        return params["sh0"]
    rest, used = params["sh_rest"], (degree + 1) ** 2 - 1
    return torch.cat([params["sh0"], rest if rest.shape[1] == used else rest[:, :used]], dim=1)


def rotated(vectors: Tensor, quats: Tensor) -> Tensor:
    """(N, 3) vectors turned by (N, 4) quaternions wxyz of any length."""
    quats = torch.nn.functional.normalize(quats, dim=-1)
    w, axis = quats[:, :1], quats[:, 1:]
    twice = 2 * torch.linalg.cross(axis, vectors)
    return vectors + w * twice + torch.linalg.cross(axis, twice)


def children(params: Columns, scales: Tensor, generator: torch.Generator) -> Columns:
    """Two children per point, drawn from the point's own Gaussian and smaller by SHRINK.

    Args:
        params: Raw columns of M points.
        scales: (M, 3) standard deviations along the point's axes, local units; 0 where the point has no extent.
        generator: Where the draws come from; on the CPU, so that the device does not change them.
    """
    twin = {name: torch.cat([value, value]) for name, value in params.items()}
    draw = torch.randn(2 * len(scales), 3, generator=generator).to(scales)
    twin["means"] = twin["means"] + rotated(draw * torch.cat([scales, scales]), twin["quats"])
    twin["scales"] = twin["scales"] - math.log(SHRINK)
    return twin


def apply(primitive: Primitive, points: Points, edit: Edit, generator: torch.Generator) -> Points:
    """Points after an edit: the kept in their order, then clones, then children. Moments and statistics follow rows."""
    points, added, keep = _nudged(points, edit), [], None
    if edit.clone is not None and edit.clone.any():
        rows = torch.arange(len(points)).to(edit.clone.device).repeat_interleave(edit.clone.to(torch.int64))
        added.append({name: value[rows] for name, value in points.params.items()})
    if edit.split is not None and edit.split.any():
        rows = {name: value[edit.split] for name, value in points.params.items()}
        added.append(primitive.split(rows, generator))
        keep = ~edit.split
    if edit.drop is not None and edit.drop.any():
        keep = ~edit.drop if keep is None else keep & ~edit.drop
    if keep is not None:
        points = points.take(keep)
    if added:
        points = points.append({name: torch.cat([rows[name] for rows in added]) for name in points.params})
    return points if edit.max_opacity is None else _dimmed(points, edit.max_opacity)


def to_table(primitive: Primitive, params: Columns) -> SplatTable:
    """The points as files hold them, local frame."""
    splats = primitive.activate({name: value.detach() for name, value in params.items()}, 0)
    return SplatTable(
        kind=splats.kind,
        means=splats.means,
        quats=splats.quats,
        log_scales=splats.scales.log(),
        opacity_logits=params["opacities"].detach(),
        sh0=params["sh0"].detach()[:, 0],
        sh_rest=params["sh_rest"].detach(),
        antialias=splats.antialias,
    )


def _nudged(points: Points, edit: Edit) -> Points:
    """Points whose parameters have been moved and whose moments have been forgotten, where the edit asks for it."""
    params, moments = points.params, [points.exp_avg, points.exp_avg_sq]
    if edit.nudge is not None:
        params = params | {name: params[name] + shift for name, shift in edit.nudge.items()}
    if edit.forget is not None and edit.forget.any():
        kept = ~edit.forget
        moments = [{k: v * kept.view(-1, *[1] * (v.dim() - 1)) for k, v in group.items()} for group in moments]
    return Points(params, *moments, points.stats)


def _dimmed(points: Points, most: float) -> Points:
    """Points with opacities of at most `most`, whose optimiser starts anew for the opacities."""
    logit = math.log(most / (1 - most))
    zero = torch.zeros_like(points.params["opacities"])
    return Points(
        points.params | {"opacities": points.params["opacities"].clamp_max(logit)},
        points.exp_avg | {"opacities": zero},
        points.exp_avg_sq | {"opacities": zero.clone()},
        points.stats,
    )
