"""The gradient of a signed distance field: by autograd (NeuS), or by differences over a step (Neuralangelo)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor


class Distances(Protocol):
    """(P,) signed distances and (P, C) features of (P, 3) positions, from the first `levels` of a grid."""

    def __call__(self, x: Tensor, levels: int | None = None) -> tuple[Tensor, Tensor]: ...


@dataclass(frozen=True)
class Geometry:
    """What is known of a field at P positions.

    Attributes:
        sdf: (P,) signed distances.
        gradient: (P, 3).
        features: (P, C) for the colour.
        laplacian: (P,) sum of the second derivatives; None with the analytic gradient.
    """

    sdf: Tensor
    gradient: Tensor
    features: Tensor
    laplacian: Tensor | None = None

    @property
    def normal(self) -> Tensor:
        """(P, 3) unit vectors."""
        return torch.nn.functional.normalize(self.gradient, dim=1)


def analytic(field: Distances, x: Tensor, levels: int | None = None) -> Geometry:
    """The gradient by autograd; it can be differentiated again where gradients are wanted."""
    wanted = torch.is_grad_enabled()
    with torch.enable_grad():
        x = x.detach().requires_grad_()
        sdf, features = field(x, levels)
        (gradient,) = torch.autograd.grad(sdf.sum(), x, create_graph=wanted)
    return Geometry(sdf, gradient, features) if wanted else Geometry(sdf.detach(), gradient, features.detach())


def numerical(field: Distances, x: Tensor, step: float, levels: int | None = None) -> Geometry:
    """Central differences over `step` along each axis: cells of a grid that lie within the step learn together
    (Li et al. 2023, eq. 3)."""
    moves = step * torch.cat([torch.eye(3, device=x.device), -torch.eye(3, device=x.device)]).to(x)
    near = torch.cat([x[None], x[None] + moves[:, None]]).flatten(0, 1)
    distances, features = field(near, levels)
    sdf, upper, lower = distances.view(7, -1).split([1, 3, 3])
    gradient = ((upper - lower) / (2 * step)).T
    laplacian = ((upper + lower - 2 * sdf) / step**2).sum(0)
    return Geometry(sdf[0], gradient, features[: len(x)], laplacian)
