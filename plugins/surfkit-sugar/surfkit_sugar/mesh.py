"""The mesh of a level of the density: points of the level along rays, and Poisson reconstruction from these."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import normalize

from surfkit.mesh.poisson import MIN_ORIENTED_POINTS, reconstructed, require_open3d, seen_pixels
from surfkit.mesh.simplify import require_simplification, simplify_to
from surfkit.plugin import BadInput, Mesh, Mesher, MeshInput
from surfkit_sugar.density import Ellipsoids, added, density, gathered, turned, whitened
from surfkit_sugar.neighbours import nearest

CHUNK = 20_000
"""Pixels at a time: 20,000 x 16 neighbours x 21 samples are 27 MB."""


@dataclass(frozen=True)
class LevelSetPoisson(Mesher):
    """Points where rays first meet a level of the density, with its gradient as normals, then screened Poisson
    reconstruction and fewer triangles (SuGaR, section 4.2); needs open3d and
    fast-simplification."""

    level: float = 0.3
    """Density of the surface; published: 0.3, also 0.1 and 0.5."""

    samples: int = 21
    """Places along each ray."""

    reach: float = 3.0
    """Half of the searched length of a ray, in standard deviations along the ray of the nearest Gaussian."""

    neighbours: int = 16
    """Gaussians that count at a place: those with the nearest centres to the rendered surface point of the ray."""

    points: int = 2_000_000
    """Number of pixels looked at, taken evenly from all views; published: 10,000,000."""

    depth: Literal["median", "expected"] = "median"
    """Which rendered depth the rays are searched around."""

    octree: int = 10
    """Depth of the octree: the longest side of the scene is divided into 2^octree cells."""

    thin: float = 0.1
    """Share of the vertices to remove, those with the lowest point density: Poisson reconstruction closes open
    surfaces."""

    triangles: int = 1_000_000
    """Most triangles; others are merged. 0 sets no limit; published: 200,000 or 1,000,000."""

    def __post_init__(self) -> None:
        if not 3 <= self.octree <= 16:
            raise BadInput(f"mesh: sugar.octree is {self.octree}; it must be 3 to 16")
        if not (0 < self.level < 1 and self.samples >= 2 and self.reach > 0 and self.neighbours >= 1):
            raise BadInput(
                f"mesh: sugar has level {self.level:g}, samples {self.samples}, reach {self.reach:g} and neighbours "
                f"{self.neighbours}; give a level between 0 and 1, 2 or more, above 0, and 1 or more"
            )
        if self.points < MIN_ORIENTED_POINTS or not 0 <= self.thin < 1 or self.triangles < 0:
            raise BadInput(
                f"mesh: sugar has points {self.points}, thin {self.thin:g} and triangles {self.triangles}; give "
                f"{MIN_ORIENTED_POINTS} or more, 0 or more below 1, and 0 or more"
            )

    def ready(self) -> None:
        """See `Mesher.ready`."""
        require_open3d("mesh:sugar")
        if self.triangles:
            require_simplification("mesh:sugar")

    def mesh(self, subject: MeshInput) -> Mesh:
        """See `Mesher.mesh`."""
        solid, share = Ellipsoids.of(subject.splats), -(-self.points // len(subject.views))
        field, looked, found = Search(self, solid), 0, []
        for at in range(len(subject.views)):
            pixels = seen_pixels(subject, at, share, self.depth)
            looked += len(pixels.points)
            for rows in torch.arange(len(pixels.points)).split(CHUNK):
                points, normals, met = field.crossings(pixels.points[rows], pixels.rays[rows])
                found.append((points, normals, pixels.colors[rows][met]))
        none = (torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.uint8))
        points, normals, colors = (torch.cat(part) for part in zip(*(found or [none]), strict=True))
        if len(points) < MIN_ORIENTED_POINTS:
            raise BadInput(
                f"mesh: the density crosses {self.level:g} before {len(points)} of {looked:,} pixels that have a depth "
                f"in {len(subject.views)} views; lower --mesh.level, raise --mesh.reach, or train longer"
            )
        made = reconstructed(points, normals, colors, self.octree, self.thin, "mesh:sugar")
        count = len(made.faces)
        if self.triangles:
            made = simplify_to(made, self.triangles)
        return replace(made, facts={"pixels": looked, "level_set_points": len(points), "triangles_before": count})


@dataclass(frozen=True)
class Search:
    """The search for a level of the density along rays."""

    settings: LevelSetPoisson
    solid: Ellipsoids

    def crossings(self, places: Tensor, rays: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Where rays first come from below the level to it, the outward normals there, and which rays do.

        Args:
            places: (M, 3) around which to search.
            rays: (M, 3) unit directions away from the camera.

        Returns:
            (P, 3), (P, 3) of length 1, and (M,) bool with P rays.
        """
        wanted, solid = self.settings, self.solid
        rows = nearest(solid.means, wanted.neighbours, places)
        first = rows[:, 0]
        along = (rays[:, None] @ solid.axes[first])[:, 0] * solid.scales[first]
        reach = wanted.reach * along.norm(dim=1)
        near = gathered(solid.table(), rows)
        steps = torch.linspace(-1, 1, wanted.samples).to(places) * reach[:, None]
        amounts = self.along(near, places, rays, steps)
        enters = (amounts[:, :-1] < wanted.level) & (amounts[:, 1:] >= wanted.level)
        met = enters.any(1)
        at = enters.to(torch.int8).argmax(1)[met, None]
        low, high = amounts[met].gather(1, at)[:, 0], amounts[met].gather(1, at + 1)[:, 0]
        near_end, far_end = steps[met].gather(1, at)[:, 0], steps[met].gather(1, at + 1)[:, 0]
        share = (wanted.level - low) / (high - low)
        points = places[met] + (near_end + share * (far_end - near_end))[:, None] * rays[met]
        _, falls = density(near[:, met], points)
        return points, normalize(falls, dim=1), met

    def along(self, near: Tensor, places: Tensor, rays: Tensor, steps: Tensor) -> Tensor:
        """(M, S) densities at (M, S) distances along rays from places: exponents are quadratic in the distance."""
        rows = near.unbind(0)
        offset, slope = whitened(rows, places), turned(rows, [ray[:, None] for ray in rays.unbind(1)])
        constant, linear, square = (added(a * b for a, b in zip(*pair, strict=True)) for pair in (
            (offset, offset), (offset, slope), (slope, slope)
        ))  # fmt: skip
        total = torch.zeros_like(steps)
        for k in range(near.shape[2]):
            exponent = constant[:, k, None] + steps * (2 * linear[:, k, None] + steps * square[:, k, None])
            total += near[12, :, k, None] * torch.exp(-0.5 * exponent)
        return total
