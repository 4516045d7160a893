"""A multi-resolution hash encoding of positions (Müller et al. 2022, Instant-NGP, eq. 2 to 4)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from surfkit.plugin import require_within

PRIMES = (1, 2_654_435_761, 805_459_861)
INITIAL = 1e-4
"""Features begin evenly spread between minus and plus this."""


@dataclass(frozen=True)
class Grid:
    """The grids of a hash encoding."""

    levels: int = 8
    """Number of grids."""

    features: int = 2
    """Learned numbers at each grid point."""

    table_bits: int = 16
    """Each grid has a table of at most 2 to this power rows; grids with more points share rows by a hash."""

    coarsest: int = 16
    """Cells along the cube in the first grid."""

    finest: int = 512
    """Cells along the cube in the last grid."""

    def __post_init__(self) -> None:
        require_within({"levels": (1, 32), "features": (1, 16), "table_bits": (4, 24), "coarsest": (1, 2**16)}, self)
        require_within({"finest": (self.coarsest, 2**20)}, self)

    @property
    def resolutions(self) -> tuple[int, ...]:
        """Cells along the cube at each level: N_l = floor(N_min b^l) with b = (N_max / N_min)^(1 / (L - 1))."""
        growth = math.log(self.finest / self.coarsest) / max(1, self.levels - 1)
        return tuple(math.floor(self.coarsest * math.exp(level * growth) + 1e-6) for level in range(self.levels))

    @property
    def rows(self) -> tuple[int, ...]:
        """Rows of the table of each level: one for each grid point, where there is room."""
        return tuple(min((n + 1) ** 3, 2**self.table_bits) for n in self.resolutions)

    @property
    def size(self) -> int:
        """Learned numbers in all."""
        return self.features * sum(self.rows)


class HashGrid(nn.Module):
    """Features of positions in a cube, interpolated between the corners of the cells that they lie in.

    Args:
        grid: Its sizes.
        reach: The cube goes from minus to plus this along each axis; positions beyond it count as those on its side.
        draw: Of the initial features.
    """

    def __init__(self, grid: Grid, reach: float, draw: torch.Generator) -> None:
        super().__init__()
        self.grid, self.reach = grid, reach
        starts = torch.tensor([0, *grid.rows]).cumsum(0)[:-1]
        self.starts = starts.tolist()
        self.table = nn.Parameter((2 * torch.rand(sum(grid.rows), grid.features, generator=draw) - 1) * INITIAL)

    @property
    def width(self) -> int:
        """Features of a position, of all levels."""
        return self.grid.levels * self.grid.features

    def cell(self, level: int) -> float:
        """Side of a cell of a level, counted from 0."""
        return 2 * self.reach / self.grid.resolutions[level]

    def forward(self, x: Tensor, levels: int | None = None) -> Tensor:
        """(P, levels x features) of (P, 3) positions; only the first `levels` are looked up, the others are 0."""
        used = self.grid.levels if levels is None else min(levels, self.grid.levels)
        place = (x / (2 * self.reach) + 0.5).clamp(0, 1)
        rows, shares = zip(*(self._cells(place, level) for level in range(used)), strict=True)
        values = nn.functional.embedding(torch.stack(rows, 1), self.table).unflatten(2, (2, 2, 2))  # (P, L, z, y, x, F)
        share = torch.stack(shares, 1)
        for axis in (2, 1, 0):
            values = torch.lerp(
                values[:, :, 0], values[:, :, 1], share[:, :, axis].unflatten(1, (used, *[1] * (axis + 1)))
            )
        found = values.flatten(1)
        return nn.functional.pad(found, (0, self.width - found.shape[1]))

    def _cells(self, place: Tensor, level: int) -> tuple[Tensor, Tensor]:
        """(P, 8) rows of the table, of the corners of the cells around (P, 3) places in [0, 1], and the (P, 3) places
        in those cells."""
        scaled = place * self.grid.resolutions[level]
        low = scaled.detach().floor().clamp_max(self.grid.resolutions[level] - 1)
        return self._rows(low.long(), level), scaled - low

    def _rows(self, low: Tensor, level: int) -> Tensor:
        """(P, 8) rows of the table, of the corners of cells with the lowest corners (P, 3); x changes fastest."""
        side, rows = self.grid.resolutions[level] + 1, self.grid.rows[level]
        both = torch.stack([low, low + 1], 2)  # (P, 3, 2)
        if side**3 <= rows:
            x, y, z = (both[:, axis] * side**axis for axis in range(3))
            at = z[:, :, None, None] + y[:, None, :, None] + x[:, None, None, :]
        else:
            x, y, z = (both[:, axis] * PRIMES[axis] for axis in range(3))
            at = (z[:, :, None, None] ^ y[:, None, :, None] ^ x[:, None, None, :]) & (rows - 1)
        return at.flatten(1) + self.starts[level]
