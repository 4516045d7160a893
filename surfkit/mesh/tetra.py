"""Marching tetrahedra over points that the splats place, where they are needed.

Gaussian Opacity Fields (Yu et al. 2024): the corners of the splats' boxes and their centres are tetrahedralised, the
field says at every point how much the splats hide of it from the views that see it best, and the surface is where that
is a half.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.core.events import Warned, emit
from surfkit.mesh.base import Mesh, Mesher, MeshInput
from surfkit.mesh.delaunay import TETRA_EDGES, crossing
from surfkit.mesh.field import ViewOpacityField, vertex_colors
from surfkit.scene.rotations import rotations

TRIANGLES = (
    (), (0, 1, 2), (0, 4, 3), (1, 2, 4, 1, 4, 3), (1, 3, 5), (0, 5, 2, 0, 3, 5), (0, 4, 5, 0, 5, 1), (2, 4, 5),
    (2, 5, 4), (0, 1, 5, 0, 5, 4), (0, 5, 3, 0, 2, 5), (1, 5, 3), (1, 3, 4, 1, 4, 2), (0, 3, 4), (0, 2, 1), (),
)  # fmt: skip
"""Edges of a positively oriented tetrahedron whose points make its triangles, by the bits of the vertices inside."""

MAX_BISECTIONS = 52
"""Halvings after which float64 has no more digits."""


@dataclass(frozen=True)
class Tetra(Mesher):
    """Marching tetrahedra on points around the splats, with the opacity field of the views (GOF)."""

    reach: float = 3.0
    """Half side of the box around a splat, whose corners become points, in standard deviations."""

    thickness: float = 0.1
    """Half thickness of the box of a surfel, as a share of its smaller half side."""

    faint: float = 0.05
    """Minimum opacity of splats that give points."""

    level: float = 0.5
    """Opacity at the surface."""

    bisections: int = 8
    """Bisection steps along each edge to find the surface."""

    agree: float = 0.2
    """Share of the views of a place that must see it as free space for it to be outside; at 0 one view is enough
    (GOF)."""

    min_views: int = 2
    """Minimum number of views that see a place; with fewer it is unknown, and there is no surface there."""

    longest: float = 1.0
    """Maximum length of an edge that gives triangles, as a multiple of the boxes of the splats at its ends; 0 sets no
    limit."""

    def __post_init__(self) -> None:
        if not (self.reach > 0 and self.thickness > 0):
            raise BadInput(f"mesh: tetra.reach is {self.reach} and thickness {self.thickness}; both must be positive")
        if not (0 < self.level < 1 and 0 <= self.agree < 1):
            raise BadInput(f"mesh: tetra.level is {self.level} and agree {self.agree}; both must lie between 0 and 1")
        if not 0 <= self.bisections <= MAX_BISECTIONS or self.min_views < 1 or self.longest < 0:
            raise BadInput(
                f"mesh: tetra.bisections {self.bisections}, min-views {self.min_views}, longest {self.longest}: "
                f"give 0 to {MAX_BISECTIONS}, 1 or more, 0 or more"
            )

    def mesh(self, subject: MeshInput) -> Mesh:
        """See `Mesher.mesh`."""
        points, rows, half = pivots(subject, self.faint, self.reach, self.thickness)
        field = ViewOpacityField(subject, self.level, self.agree)
        hidden, views = field.hidden(points, "looking at points")
        edges = SurfaceBracket(points, half.norm(dim=1)[rows], (views >= self.min_views).numpy(), hidden.numpy())
        return edges.surface(subject, self.bisections, self.longest, lambda at, what: field.hidden(at, what)[0])


def pivots(subject: MeshInput, faint: float, reach: float, thickness: float) -> tuple[Tensor, Tensor, Tensor]:
    """The points to tetrahedralise: the centre and the eight corners of a box around each splat (GOF).

    Args:
        subject: Splats, and the generator that moves the points a little: the corners of a box lie on one sphere, where
            a tetrahedralisation is not unique.
        faint: Minimum opacity of splats that give points.
        reach: Half sides of the boxes, in standard deviations.
        thickness: Half thickness of the box of a surfel, as a share of its smaller half side.

    Returns:
        (P, 3) float64 points, (P,) int64 which of the M splats used each belongs to, and (M, 3) the half sides of their
        boxes.

    Raises:
        BadInput: All splats are too faint.
    """
    splats = subject.splats
    kept = splats.opacities >= faint
    if not kept.any():
        raise BadInput(f"mesh: none of {len(splats):,} splats has an opacity of {faint}; lower --mesh.faint")
    half = reach * splats.scales[kept].double()
    if half.shape[1] == 2:
        half = torch.cat([half, thickness * half.amin(1, keepdim=True)], 1)
    signs = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0], dtype=torch.float64)] * 3)
    signs = torch.cat([torch.zeros(1, 3, dtype=torch.float64), signs])
    offsets = (half[:, None] * signs) @ rotations(splats.quats[kept].double()).transpose(1, 2)
    points = (splats.means[kept].double()[:, None] + offsets).flatten(0, 1)
    rows = torch.arange(len(half)).repeat_interleave(len(signs))
    size = half.norm(dim=1)[rows]
    points += 1e-3 * size[:, None] * (torch.rand(points.shape, generator=subject.generator, dtype=torch.float64) - 0.5)
    return points, rows, half


@dataclass(frozen=True)
class SurfaceBracket:
    """Points on both sides of a surface.

    Attributes:
        points: (P, 3) float64, in general position.
        sizes: (P,) lengths; an edge is long compared with the sum of those at its ends.
        known: (P,) bool, whether it is known on which side a point lies.
        inside: (P,) bool.
    """

    points: Tensor
    sizes: Tensor
    known: np.ndarray
    inside: np.ndarray

    def surface(
        self, subject: MeshInput, bisections: int, longest: float, hidden: Callable[[Tensor, str], Tensor]
    ) -> Mesh:
        """The surface between the points inside and those outside, coloured, by marching tetrahedra.

        Args:
            subject: What is meshed.
            bisections: Steps in which it is searched along each edge.
            longest: Maximum length of an edge, as a multiple of the sizes at its ends; 0 sets no limit.
            hidden: Tells (E,) bool whether (E, 3) places are inside; and is told what the work is, for those who wait.

        Raises:
            BadInput: All points are on the same side.
        """
        points, inside, known = self.points, self.inside, self.known
        if not (known & inside).any() or not (known & ~inside).any():
            raise BadInput(
                f"mesh: of {len(points):,} points around the splats {int((known & inside).sum()):,} are hidden and "
                f"{int((known & ~inside).sum()):,} in the open, so no surface lies between; train longer, or lower "
                "--mesh.faint"
            )
        tets, doubtful = crossing(points.numpy(), known, inside, subject.budget_bytes)
        if doubtful:
            told = f"mesh: {doubtful:,} of {len(tets):,} tetrahedra at the borders of tiles may not fit"
            emit(Warned(f"{told}; give more memory"))
        edges, faces = triangles(tets, inside, points.numpy())
        ends = torch.from_numpy(edges)
        low, high = points[ends[:, 0]], points[ends[:, 1]]  # inside, outside
        length = (low - high).norm(dim=1)
        for at in range(bisections):
            middle = (low + high) / 2
            within = hidden(middle, f"searching the surface, {at + 1} of {bisections}")[:, None]
            low, high = torch.where(within, middle, low), torch.where(within, high, middle)
        vertices = (low + high) / 2
        if longest:
            near = (length <= longest * (self.sizes[ends[:, 0]] + self.sizes[ends[:, 1]])).numpy()
            faces = faces[near[faces].all(1)]
        corners, faces = used(vertices.numpy(), faces)
        return Mesh(corners.astype(np.float32), faces.astype(np.int32), vertex_colors(subject, corners))


def triangles(tets: np.ndarray, inside: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The edges that the surface crosses and the triangles between them, facing outwards.

    Args:
        tets: (T, 4) rows of `points`.
        inside: (P,) bool.
        points: (P, 3).

    Returns:
        (E, 2) int64 rows of points, the one inside first, and (F, 3) int64 rows of edges.
    """
    edges, at = np.unique(crossed_edges(oriented(tets, points), inside).reshape(-1, 2), axis=0, return_inverse=True)
    return edges, at.reshape(-1, 3)


def oriented(tets: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(T, 4) tetrahedra with their corners in rising order, but for the first two where that orients them positively.

    Args:
        tets: (T, 4) rows of `points`.
        points: (P, 3).
    """
    tets = np.sort(tets, axis=1)  # which diagonal cuts a quadrilateral must not depend on the tile
    a, b, c, d = points[tets].transpose(1, 0, 2)
    turned = np.einsum("ni,ni->n", np.cross(b - a, c - a), d - a) < 0
    return np.where(turned[:, None], tets[:, [1, 0, 2, 3]], tets)


def crossed_edges(tets: np.ndarray, inside: np.ndarray) -> np.ndarray:
    """(F, 3, 2) int64: each triangle of the surface as three edges that it crosses, the point inside first.

    Args:
        tets: (T, 4) rows of points, as `oriented` gives them.
        inside: (P,) bool.
    """
    case = (inside[tets] << np.arange(4)).sum(1)
    found = []
    for bits, table in enumerate(TRIANGLES):
        rows = tets[case == bits]
        ends = rows[:, np.array(TETRA_EDGES)[list(table)]] if table else np.empty((0, 3, 2), np.int64)
        found.append(ends.reshape(-1, 2))
    ends = np.concatenate(found)
    return np.where(inside[ends[:, :1]], ends, ends[:, ::-1]).reshape(-1, 3, 2)


def used(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The vertices that some face needs, and the faces by their new rows."""
    kept, at = np.unique(faces, return_inverse=True)
    return vertices[kept], at.reshape(-1, 3)
