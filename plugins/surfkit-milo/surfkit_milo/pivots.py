"""Pivots: the centre and the eight corners of a box around a Gaussian, with a trained value each (MILo, 4.1)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from surfkit.plugin import (
    BadInput,
    Column,
    Columns,
    Gaussian3D,
    LearningRate,
    SparsePoints,
    Splats,
    crossed_edges,
    oriented,
    rotated,
    tetrahedralised,
)

PIVOTS = 9
"""Of a Gaussian."""
REACH = 3.0
"""Half sides of the box, in standard deviations (GOF)."""
SIGNS = torch.cat([torch.zeros(1, 3), torch.cartesian_prod(*[torch.tensor([-1.0, 1.0])] * 3)])
"""(9, 3) where pivots are in the box; the centre is the first."""


@dataclass(frozen=True)
class Pivoted(Gaussian3D):
    """Gaussians that carry the corners of a tetrahedralisation, their pivots, with a value at each (MILo)."""

    divides: ClassVar[bool] = False  # the mesh is that of all points

    def columns(self) -> dict[str, Column]:
        """Those of Gaussians, and: "occupancies" (9,), trained, the signed distance of each pivot in units of half the
        diagonal of the box, below 0 inside; "spread" (), by how much the box is enlarged, 0 for no pivots."""
        added = {"occupancies": Column((PIVOTS,), LearningRate(0.01)), "spread": Column((), LearningRate(0.0))}
        return super().columns() | added

    def init(self, cloud: SparsePoints, generator: torch.Generator) -> Columns:
        """Balls without pivots."""
        count = len(cloud.xyz)
        none = {"occupancies": torch.zeros(count, PIVOTS), "spread": torch.zeros(count)}
        return super().init(cloud, generator) | none

    def activate(self, params: Columns, degree: int) -> Splats:
        """Gaussians, with both columns beside them."""
        extra = {"occupancies": params["occupancies"], "spread": params["spread"].detach()}
        return replace(super().activate(params, degree), extra=extra)


def require_pivots(splats: Splats, what: str) -> None:
    """BadInput unless splats have pivots; `what` needs them."""
    if "occupancies" not in splats.extra:
        raise BadInput(f"{what} needs Gaussians with pivots; choose primitive:pivoted")


@dataclass(frozen=True)
class Boxes:
    """N boxes, in any float type.

    Attributes:
        centres: (N, 3).
        quats: (N, 4) wxyz.
        half: (N, 3) half sides.
        occupancies: (N, 9), in units of `sizes`.
    """

    centres: Tensor
    quats: Tensor
    half: Tensor
    occupancies: Tensor

    @classmethod
    def of(cls, splats: Splats, spread: Tensor, rows: Tensor | None = None) -> Boxes:
        """Boxes of some splats, (K,) int64 rows, or of all; with the graph to the splats.

        Args:
            splats: With pivots.
            spread: (N,) by how much boxes are enlarged.
            rows: See above.
        """
        half = REACH * spread[:, None] * splats.scales
        parts = splats.means, splats.quats, half, splats.extra["occupancies"]
        return cls(*(part if rows is None else part.index_select(0, rows) for part in parts))

    def double(self) -> Boxes:
        """The same in float64."""
        return Boxes(self.centres.double(), self.quats.double(), self.half.double(), self.occupancies.double())

    @property
    def sizes(self) -> Tensor:
        """(N,) half diagonals, constant: the unit of the values."""
        return self.half.detach().norm(dim=1)

    def places(self) -> Tensor:
        """(N, 9, 3) positions of the pivots."""
        signs = SIGNS.to(self.half)
        offsets = (self.half[:, None] * signs).reshape(-1, 3)
        return self.centres[:, None] + rotated(offsets, self.quats.repeat_interleave(PIVOTS, 0)).view(-1, PIVOTS, 3)

    def at(self, pivots: Tensor) -> tuple[Tensor, Tensor]:
        """(K, 3) positions and (K,) values, lengths below 0 inside, of (K,) int64 pivots."""
        box, corner = pivots // PIVOTS, pivots % PIVOTS
        centre, quat, half = (part.index_select(0, box) for part in (self.centres, self.quats, self.half))
        value = self.occupancies.flatten().index_select(0, pivots) * self.sizes[box]
        return centre + rotated(half * SIGNS.to(half)[corner], quat), value


def tetrahedra(places: Tensor) -> np.ndarray:
    """(T, 4) int64 Delaunay tetrahedra of (P, 3) places, each as `oriented` gives it."""
    points = places.detach().double().cpu().numpy()
    if len(points) < 5:
        return np.empty((0, 4), np.int64)
    tets = tetrahedralised(points).corners.astype(np.int64)
    return oriented(tets[(tets < len(points)).all(1)], points)  # without those that enclose all


def crossings(tets: np.ndarray, boxes: Boxes, longest: float) -> np.ndarray:
    """(F, 3, 2) int64: the corners of each triangle of the surface, as the two pivots, the inside one first, between
    which they lie.

    Args:
        tets: (T, 4) pivots, as `tetrahedra` gives them.
        boxes: Theirs.
        longest: Maximum length of an edge, as a multiple of the half diagonals at its ends, added up; 0 sets no limit.
    """
    inside = (boxes.occupancies.detach() < 0).flatten().cpu().numpy()
    some = inside[tets]
    ends = crossed_edges(tets[some.any(1) & ~some.all(1)], inside)
    if not longest or not len(ends):
        return ends
    places = boxes.places().detach().reshape(-1, 3).cpu().numpy()
    reach = longest * boxes.sizes.cpu().numpy()
    length = np.linalg.norm(places[ends[..., 0]] - places[ends[..., 1]], axis=-1)
    return ends[(length <= (reach[ends // PIVOTS]).sum(-1)).all(1)]


def vertices(boxes: Boxes, ends: Tensor) -> Tensor:
    """(K, 3) points of (K, 2) edges at which the value, linear along an edge, is 0; differentiable in boxes.

    Args:
        boxes: Of the pivots.
        ends: Pivots, int64: the one with a value below 0 first.
    """
    (low, high), (below, above) = zip(boxes.at(ends[:, 0]), boxes.at(ends[:, 1]), strict=True)
    share = below / (below - above)
    return low + share[:, None] * (high - low)
