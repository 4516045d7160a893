"""The density of Gaussians in space: d(p) = sum of opacity exp(-M^2 / 2), M the Mahalanobis distance (SuGaR, eq. 4)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import reduce

import torch
from torch import Tensor

from surfkit.plugin import Splats
from surfkit.scene.rotations import rotations

THICKNESS = 0.1
"""Third scale of surfels, as a share of the smaller of their two: a disc without thickness has no density."""


@dataclass(frozen=True)
class Ellipsoids:
    """N Gaussians as densities need them.

    Attributes:
        means: (N, 3).
        axes: (N, 3, 3) orthonormal axes as columns.
        scales: (N, 3) along the axes.
        opacities: (N,).
    """

    means: Tensor
    axes: Tensor
    scales: Tensor
    opacities: Tensor

    @classmethod
    def of(cls, splats: Splats) -> Ellipsoids:
        """Of splats; surfels get a thickness."""
        scales = splats.scales
        if scales.shape[1] == 2:
            scales = torch.cat([scales, THICKNESS * scales.amin(1, keepdim=True)], 1)
        return cls(splats.means, rotations(splats.quats), scales, splats.opacities)

    def normals(self) -> Tensor:
        """(N, 3) axes of the smallest scale; their sign means nothing."""
        at = self.scales.argmin(1)
        return self.axes.gather(2, at[:, None, None].expand(-1, 3, 1))[:, :, 0]

    def thinnest(self) -> Tensor:
        """(N,) smallest scales."""
        return self.scales.amin(1)

    def table(self) -> Tensor:
        """(13, N) means, the rows of diag(1 / scales) axes^T one after the other, opacities; for `gathered`."""
        whitening = (self.axes / self.scales[:, None]).transpose(1, 2)
        return torch.cat([self.means, whitening.flatten(1), self.opacities[:, None]], 1).T


def gathered(table: Tensor, rows: Tensor) -> Tensor:
    """(C, ...) columns of a (C, N) table at int64 `rows` of any shape.

    Its gradients are added up row by row, in an order that threads do not decide.
    """
    return table.gather(1, rows.reshape(1, -1).expand(len(table), -1)).view(len(table), *rows.shape)


def whitened(near: Sequence[Tensor], places: Tensor) -> list[Tensor]:
    """Offsets of places from Gaussians in units of their sigmas: (M, K) along each of their axes.

    Args:
        near: 13 of (M, K), the rows of `gathered`: K Gaussians for each place.
        places: (M, 3).
    """
    return turned(near, [place[:, None] - mean for place, mean in zip(places.unbind(1), near[:3], strict=True)])


def turned(near: Sequence[Tensor], vectors: Sequence[Tensor]) -> list[Tensor]:
    """(M, K) components of vectors along the axes of Gaussians, in units of their sigmas, from those in space."""
    x, y, z = vectors
    return [near[3 + 3 * k] * x + near[4 + 3 * k] * y + near[5 + 3 * k] * z for k in range(3)]


def added(terms: Iterable[Tensor]) -> Tensor:
    """Their sum, in their order; one term at least."""
    return reduce(torch.add, terms)


def density(near: Tensor, places: Tensor) -> tuple[Tensor, Tensor]:
    """(M,) density of Gaussians near places, and (M, 3) the direction in which it falls: -gradient / density.

    Args:
        near: (13, M, K) of `gathered`: the K Gaussians that count at each place.
        places: (M, 3).
    """
    rows = near.unbind(0)  # once: the way back of each index would fill a whole table
    offsets = whitened(rows, places)
    shares = rows[12] * torch.exp(-0.5 * added(offset.square() for offset in offsets))
    total = shares.sum(1)
    shares = shares / total.detach().clamp_min(1e-30)[:, None]
    pulls = [shares * offset for offset in offsets]
    falls = [added((pulls[k] * rows[3 + 3 * k + axis]).sum(1) for k in range(3)) for axis in range(3)]
    return total, torch.stack(falls, 1)
