"""Triangles: their frames, circles packed into them, and which of them share an edge."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import normalize

from surfkit_sugar.density import gathered

SLIVER = 1e-4
"""Triangles whose ellipse is narrower than this share of its length have no normal to speak of."""


def corners(vertices: Tensor, rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """First corners (M, 3) of triangles, and the edges (M, 3) from there to the second and to the third corners.

    Args:
        vertices: (V, 3).
        rows: (M, 3) int64 rows of `vertices`.
    """
    first, second, third = gathered(vertices.T, rows).permute(2, 1, 0)
    return first, second - first, third - first


def frames(along: Tensor, across: Tensor) -> Tensor:
    """(M, 3, 3) right-handed frames of triangles: columns are the direction of `along`, one in the plane, the normal.

    Args:
        along: (M, 3) edges from the first corner to the second.
        across: (M, 3) edges from the first corner to the third.
    """
    normal = normalize(torch.linalg.cross(along, across), dim=1)
    x = normalize(along, dim=1)
    return torch.stack([x, torch.linalg.cross(normal, x), normal], 2)


def turned(frame: Tensor, turn: Tensor) -> Tensor:
    """(M, 3, 3) frames turned about their normals by complex numbers (M, 2) of any length but 0."""
    cosine, sine = (part[:, None] for part in normalize(turn, dim=1).unbind(1))
    x, y, normal = frame.unbind(2)
    return torch.stack([cosine * x + sine * y, cosine * y - sine * x, normal], 2)


def packed(rows: int) -> tuple[Tensor, float]:
    """The largest equal circles that lie in `rows` rows in an equilateral triangle of side 1.

    Between the centres of two corners' circles lie (rows - 1) diameters, and each of these centres is a radius away
    from two sides: radius = 1 / (2 (rows - 1) + 2 sqrt 3).

    Returns:
        (rows (rows + 1) / 2, 3) float64 barycentric coordinates of the centres, and the radius.
    """
    radius = 1 / (2 * (rows - 1) + 2 * math.sqrt(3))
    inset = radius / (math.sqrt(3) / 2)
    steps = [(i, j, rows - 1 - i - j) for i in range(rows) for j in range(rows - i)]
    grid = torch.tensor(steps, dtype=torch.float64) / max(1, rows - 1)
    return inset + (1 - 3 * inset) * (grid if rows > 1 else torch.full((1, 3), 1 / 3, dtype=torch.float64)), radius


def ellipses(along: Tensor, across: Tensor) -> tuple[Tensor, Tensor]:
    """What becomes of a circle of radius 1 when an equilateral triangle of side 1 becomes each of M triangles.

    Args:
        along, across: As for `frames`.

    Returns:
        (M, 2) semi-axes, the longer first, and (M, 2) the direction of the longer one in the frame of `frames`.
    """
    frame = frames(along, across)
    x, y = ((across[:, None] @ frame)[:, 0, at] for at in range(2))
    length = along.norm(dim=1)
    shear, height = (2 * x - length) / math.sqrt(3), 2 * y / math.sqrt(3)  # [[length, shear], [0, height]]
    a, b, c = length.square() + shear.square(), shear * height, height.square()
    mean, half = (a + c) / 2, torch.hypot((a - c) / 2, b)
    major = (mean + half).sqrt()
    angle = 0.5 * torch.atan2(2 * b, a - c)
    minor = (length * height).abs() / major.clamp_min(1e-30)  # the product of both is the determinant
    return torch.stack([major, minor], 1), torch.stack([angle.cos(), angle.sin()], 1)


def pairs(faces: Tensor) -> Tensor:
    """(E, 2) int64 rows of the triangles on both sides of each edge that belongs to two of (F, 3) triangles."""
    ends = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).sort(1).values
    owner = torch.arange(len(faces), device=faces.device).repeat(3)
    _, edge, count = torch.unique(ends, dim=0, return_inverse=True, return_counts=True)
    order = edge.argsort(stable=True)
    first = count.cumsum(0) - count
    both = first[count == 2]
    return torch.stack([owner[order[both]], owner[order[both + 1]]], 1)
