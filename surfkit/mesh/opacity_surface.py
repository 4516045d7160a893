"""The mesh of an opacity field (GOF, section 4.3): where the view that sees a place best is half hidden from it.

What hides, a mesher says: the largest density before the place (`mesh:gof`), or stochastic solids (`mesh:gggs`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import torch
from torch import Tensor

from surfkit.core.check import BadInput
from surfkit.mesh.base import Mesh, Mesher, MeshInput
from surfkit.mesh.field import least_opacity
from surfkit.mesh.tetra import MAX_BISECTIONS, SurfaceBracket, pivots


@dataclass(frozen=True)
class OpacitySurface(Mesher):
    """Marching tetrahedra on the boxes of the splats, where the least opacity of all views crosses a level (GOF).

    Attributes:
        solid: Whether Gaussians hide as stochastic solids (GGGS) instead of by their largest density (GOF).
    """

    solid: ClassVar[bool] = False

    level: float = 0.5
    """Opacity at the surface."""

    reach: float = 3.0
    """Half sides of the box around a splat, whose corners become points, in standard deviations."""

    faint: float = 0.05
    """Minimum opacity of splats that give points."""

    bisections: int = 8
    """Bisection steps along each edge to find the surface."""

    min_views: int = 2
    """Minimum number of views that look at a place; with fewer it counts as unseen."""

    unseen: Literal["unknown", "inside"] = "unknown"
    """What unseen places are: unknown, so that no surface ends there, or inside (GOF), which closes the surface around
    all that is seen with a shell."""

    longest: float = 1.0
    """Maximum length of an edge that gives triangles, as a multiple of the largest half sides of the boxes at its ends,
    added up; 0 sets no limit."""

    thickness: float = 0.1
    """Half thickness of the box of a surfel, as a share of its smaller half side; ellipsoids have three half sides."""

    def __post_init__(self) -> None:
        if not (self.reach > 0 and self.thickness > 0):
            raise BadInput(f"mesh.reach is {self.reach} and thickness {self.thickness}; both must be positive")
        if not (0 < self.level < 1 and 0 <= self.faint < 1):
            raise BadInput(f"mesh.level is {self.level} and faint {self.faint}; both must lie between 0 and 1")
        if not 0 <= self.bisections <= MAX_BISECTIONS or self.min_views < 1 or self.longest < 0:
            raise BadInput(
                f"mesh.bisections {self.bisections}, min-views {self.min_views}, longest {self.longest}: "
                f"give 0 to {MAX_BISECTIONS}, 1 or more, 0 or more"
            )

    def mesh(self, subject: MeshInput) -> Mesh:
        """See `Mesher.mesh`."""
        points, rows, half = pivots(in_view(subject), self.faint, self.reach, self.thickness)
        least, views = least_opacity(subject, points, "evaluating the opacity field", solid=self.solid)
        unseen = views < self.min_views
        known, inside = torch.ones_like(unseen), least > self.level
        if self.unseen == "inside":
            inside |= unseen
        else:
            known = ~unseen

        def hidden(places: Tensor, what: str) -> Tensor:
            return least_opacity(subject, places, what, self.level, self.solid)[0] > self.level

        edges = SurfaceBracket(points, half.amax(1)[rows], known.numpy(), inside.numpy())
        mesh = edges.surface(subject, self.bisections, self.longest, hidden)
        return replace(mesh, facts={"points": len(points), "unseen_points": int(unseen.sum())})


def in_view(subject: MeshInput) -> MeshInput:
    """The same with the splats whose centre lies in some view: the others give no points.

    Raises:
        BadInput: No view shows any.
    """
    means = subject.splats.means.double()
    shown = torch.zeros(len(means), dtype=torch.bool)
    for view in subject.views:
        x, y, z = view.camera.project(means).unbind(1)
        shown |= (z > subject.near) & (x >= 0) & (y >= 0) & (x < view.camera.width) & (y < view.camera.height)
    if not shown.any():
        raise BadInput(f"mesh: none of {len(means):,} splats lies in any of {len(subject.views)} views")
    return replace(subject, splats=subject.splats.take(shown))
