"""Volumetric cutting: Poisson reconstruction of the depth that splats are near (Dai et al. 2024)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from surfkit.plugin import BadInput, MeshInput, Poisson, Splats, rotated

REACH = 3.0
"""Standard deviations up to which a splat reaches."""
INNER = 0.98
"""Share of the points, along each axis, whose box is divided into cells: a few far ones do not make them larger."""
MOST_COLUMNS = 500_000
"""Columns of cells that are looked at together: 3 cells each, of 100 bytes."""


@dataclass(frozen=True)
class CutPoisson(Poisson):
    """Screened Poisson reconstruction as mesh:poisson, of the points of depth maps that volumetric cutting leaves, as
    in GaussianSurfels; needs open3d.

    At the edge of a foreground, and where splats are faint, the mean depth of a pixel lies between two surfaces, where
    there are no splats. So space is divided into cells, each splat adds opacity x density to the cells that its plane
    meets, and the points in cells with a small sum are dropped.
    """

    cells: int = 512
    """Cells along the longest side of the box around the points of all views, 98 % of them along each axis."""

    least: float = 1.0
    """Sum over the splats of opacity x density below which a cell is cut away; 0 cuts none."""

    def __post_init__(self) -> None:
        Poisson.__post_init__(self)
        if not 2 <= self.cells <= 65_536 or not 0 <= self.least < float("inf"):
            raise BadInput(
                f"mesh: cut-poisson.cells is {self.cells} and least {self.least:g}; give 2 to 65536, and 0 or more"
            )

    def kept(self, subject: MeshInput, points: Tensor) -> Tensor:
        """See `Poisson.kept`.

        Raises:
            BadInput: All points are cut away.
        """
        if not len(points):
            return super().kept(subject, points)
        kept = weight_around(points, subject.splats, self.side(points)) >= self.least
        if not kept.any():
            raise BadInput(
                f"mesh: all {len(points):,} points lie in cells where the splats come to less than {self.least:g}; "
                "lower --mesh.least or --mesh.cells, or train longer"
            )
        return kept

    def side(self, points: Tensor) -> float:
        """Side of a cell for (P, 3) points, local units."""
        ends = [max(1, round(share * len(points))) for share in ((1 - INNER) / 2, (1 + INNER) / 2)]
        low, high = (points.kthvalue(end, dim=0).values for end in ends)
        return max(float((high - low).max()), 1e-6) / self.cells


def weight_around(points: Tensor, splats: Splats, side: float) -> Tensor:
    """(P,) sum over the splats of opacity x density in the cell of each point, a cube of a lattice.

    A splat counts in the cells that its plane meets within `REACH`. Its density in a cell is that at the place of the
    cell nearest to its centre, seen along its normal: 1 in the cell with its centre, however small the splat is.

    Args:
        points: (P, 3) local frame.
        splats: Discs, or ellipsoids, which count as discs across their shortest axis.
        side: Of a cell, local units.
    """
    corner = points.amin(0)
    wanted, of_point = key_of(((points - corner) / side).floor().long()).unique(return_inverse=True)
    total = torch.zeros(len(wanted), dtype=torch.float64)
    discs = Discs.of(splats, corner, side)
    counts = discs.columns().prod(1)
    order = counts.argsort(stable=True)  # small ones together, so that a group is of many small or few large
    for group in split_by(counts[order].cumsum(0), MOST_COLUMNS):
        at, weights = discs.take(order[group]).cells(wanted)
        total.index_add_(0, at, weights.double())
    return total[of_point].to(points)


def key_of(cells: Tensor) -> Tensor:
    """(N,) int64 numbers of cells (N, 3) that differ from cell to cell, up to 2^20 cells away from the first."""
    x, y, z = (cells.clamp(-(2**20), 2**20 - 1) + 2**20).unbind(1)
    return (x << 42) + (y << 21) + z


def split_by(sums: Tensor, most: int) -> list[slice]:
    """Parts of a list with (N,) running sums of its sizes, each of up to `most`, or of one row."""
    parts, begin, end = [], 0, len(sums)
    while begin < end:
        before = int(sums[begin - 1]) if begin else 0
        stop = max(begin + 1, int(torch.searchsorted(sums, before + most, right=True)))
        parts.append(slice(begin, stop))
        begin = stop
    return parts


@dataclass(frozen=True)
class Discs:
    """N flat splats in units of cells.

    Attributes:
        centres: (N, 3).
        axes: (N, 3, 2) unit vectors along the two axes.
        normals: (N, 3).
        scales: (N, 2) standard deviations.
        opacities: (N,).
        order: (N, 3) int64: two dimensions across which the plane is a function, and that which it gives.
    """

    centres: Tensor
    axes: Tensor
    normals: Tensor
    scales: Tensor
    opacities: Tensor
    order: Tensor

    @classmethod
    def of(cls, splats: Splats, corner: Tensor, side: float) -> Discs:
        """Splats, with the origin at a corner (3,)."""
        count, unit = len(splats), torch.eye(3).to(splats.means)
        turn = torch.stack([rotated(axis.expand(count, 3), splats.quats) for axis in unit], 2)
        three = splats.scales if splats.scales.shape[1] == 3 else torch.nn.functional.pad(splats.scales, (0, 1))
        sizes, at = three.sort(dim=1, descending=True, stable=True)
        axes = turn.gather(2, at[:, None].expand(-1, 3, -1))
        normals = axes[:, :, 2]
        steepest = normals.abs().argmax(1, keepdim=True)
        order = torch.cat([(steepest + 1) % 3, (steepest + 2) % 3, steepest], 1)
        return cls(
            (splats.means - corner) / side, axes[:, :, :2], normals, sizes[:, :2] / side, splats.opacities, order
        )

    def take(self, rows: Tensor) -> Discs:
        """Those of (M,) indices."""
        return Discs(*(value[rows] for value in vars(self).values()))

    def columns(self) -> Tensor:
        """(N, 2) int64 cells across which each reaches, along its first two dimensions."""
        low, high = self.ends()
        return high - low + 1

    def ends(self) -> tuple[Tensor, Tensor]:
        """(N, 2) int64 each: its first and last cell along its first two dimensions."""
        half = REACH * (self.axes * self.scales[:, None]).norm(dim=2).gather(1, self.order[:, :2])
        middle = self.centres.gather(1, self.order[:, :2])
        return (middle - half).floor().long(), (middle + half).floor().long()

    def cells(self, wanted: Tensor) -> tuple[Tensor, Tensor]:
        """Positions (C,) int64 among (K,) sorted keys of the cells that they meet, each as often as discs do, and (C,)
        weights."""
        (low, _), size = self.ends(), self.columns()
        count = size.prod(1)
        row = torch.arange(len(count)).repeat_interleave(count)
        within = torch.arange(len(row)) - (count.cumsum(0) - count)[row]
        across = low[row] + torch.stack([within // size[row, 1], within % size[row, 1]], 1)
        # Over a column of cells the plane rises by at most 1 cell along either dimension: it meets 3 cells at most.
        normals = self.normals.gather(1, self.order)
        slope = -(normals[:, :2] / normals[:, 2:])[row]
        offset = across + 0.5 - self.centres.gather(1, self.order[:, :2])[row]
        middle = self.centres.gather(1, self.order[:, 2:])[row, 0] + (slope * offset).sum(1)
        rise = slope.abs().sum(1) / 2
        first, last = (middle - rise).floor().long(), (middle + rise).floor().long()
        found = []
        for step in range(3):
            meets = (first + step <= last).nonzero()[:, 0]
            cell = torch.cat([across[meets], (first[meets] + step)[:, None]], 1)
            place = torch.empty_like(cell).scatter_(1, self.order[row[meets]], cell)
            key = key_of(place)
            at = torch.searchsorted(wanted, key).clamp_max(len(wanted) - 1)
            known = (wanted[at] == key).nonzero()[:, 0]  # most cells have no points
            at, of, place = at[known], row[meets[known]], place[known]
            nearest = torch.minimum(torch.maximum(self.centres[of], place.to(self.centres)), place + 1.0)
            along = torch.einsum("ni,nij->nj", nearest - self.centres[of], self.axes[of]) / self.scales[of]
            square = along.square().sum(1)
            inside = square <= REACH**2
            found.append((at[inside], (self.opacities[of] * torch.exp(-square / 2))[inside]))
        places, weights = zip(*found, strict=True)
        return torch.cat(places), torch.cat(weights)
