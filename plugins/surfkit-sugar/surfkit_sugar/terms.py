"""Terms on the points that make them opaque, flat and lie on a surface (SuGaR, section 4.1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import normalize

from surfkit.losses.two_views import is_whole, projected, sampled, surface_depth
from surfkit.plugin import BadInput, Interval, Regularizer, RegularizerInput, Splats, Steps
from surfkit_sugar.density import Ellipsoids, density, gathered
from surfkit_sugar.neighbours import nearest, remembered

REACH = 3.0
"""Largest scales of its Gaussian that a sample may be away from the rendered surface; farther, it is of another one."""
TINY = 1e-6
"""Of -2 ln d, below which the distance counts as 0: the slope of its root has no bound there."""


@dataclass(frozen=True)
class OpacityEntropy(Regularizer):
    """Mean entropy of the opacities: points become opaque or fade away."""

    weight: float = 0.1
    """Loss weight."""

    start: Steps = 7_000
    """Steps without this term."""

    until: Steps = 9_000
    """Last step with this term."""

    def __post_init__(self) -> None:
        if self.weight < 0:
            raise BadInput(f"the opacity entropy has weight {self.weight:g}; give 0 or more")

    def weight_at(self, index: int, steps: int) -> float:
        return self.weight if self.start < index <= self.until else 0.0

    def __call__(self, splats: Splats) -> Tensor:
        opacities = splats.opacities.clamp(1e-6, 1 - 1e-6)
        return -(opacities * opacities.log() + (1 - opacities) * (1 - opacities).log()).mean()


@dataclass(frozen=True)
class SurfaceField(Regularizer):
    """Density, or distance, of the Gaussians at places around them against those of Gaussians that are flat and lie on
    a surface (SuGaR, eq. 5 to 9); half of the term is for the direction in which the density falls."""

    weight: float = 0.2
    """Loss weight, from `start` on."""

    start: Steps = 9_000
    """Steps without this term."""

    mode: Literal["density", "sdf"] = "density"
    """density: |d - exp(-s^2 / 2 b^2)|, s the distance to the plane of the own Gaussian and b the mean smallest scale;
    sdf: |b sqrt(-2 ln d) - f| / b, f the distance in depth to what is rendered of the step's view."""

    normals: float = 1.0
    """Weight of the direction of the density's fall against the normal of the own Gaussian, relative to the field's."""

    samples: int = 100_000
    """Places at each step, no more than there are points; published: 1,000,000."""

    spread: float = 1.5
    """Samples are drawn from Gaussians with scales that are larger by this factor."""

    neighbours: int = 16
    """Gaussians that count at a place: those with the nearest centres to that of the own Gaussian."""

    refresh: Interval = 500
    """Steps between searches for the neighbours."""

    def __post_init__(self) -> None:
        if not (self.weight >= 0 and self.normals >= 0 and self.spread > 0):
            raise BadInput(
                f"the surface field has weight {self.weight:g}, normals {self.normals:g} and spread {self.spread:g}; "
                "give 0 or more, 0 or more, and a spread above 0"
            )
        if self.samples < 1 or self.neighbours < 1 or self.refresh < 1:
            raise BadInput(
                f"the surface field has samples {self.samples}, neighbours {self.neighbours} and refresh "
                f"{self.refresh}; each must be 1 or more"
            )

    def weight_at(self, index: int, steps: int) -> float:
        return self.weight if index > self.start else 0.0

    @property
    def reads(self) -> tuple[str, ...]:
        """See `Regularizer.reads`."""
        return ("alpha", "depth") if self.mode == "sdf" else ()

    def __call__(self, splats: Splats) -> Tensor:
        """Of the points alone: in mode sdf, f is the distance to the plane of the own Gaussian."""
        rows = self._drawn(torch.ones(len(splats), dtype=torch.bool), 0)
        return self._term(splats, nearest(splats.means, self.neighbours), rows, 0, None)

    def in_step(self, splats: Splats, given: RegularizerInput) -> Tensor:
        """See `Regularizer.in_step`."""
        near = remembered(splats.means, given, self.neighbours, self.refresh)
        sees = self.mode == "sdf"
        rows = self._drawn(given.seen if sees else torch.ones_like(given.seen), given.target.seed)
        return self._term(splats, near, rows, given.target.seed, given if sees else None)

    def _drawn(self, may: Tensor, seed: int) -> Tensor:
        """(M,) rows of Gaussians to sample, all that may be drawn equally likely."""
        rows = may.nonzero()[:, 0]
        draw = torch.Generator().manual_seed(seed)
        return rows[torch.randint(max(1, len(rows)), (min(self.samples, len(rows)),), generator=draw).to(rows.device)]

    def _term(self, splats: Splats, near: Tensor, rows: Tensor, seed: int, given: RegularizerInput | None) -> Tensor:
        solid, places = Ellipsoids.of(splats), self.places(splats, rows, seed)
        own = gathered(torch.cat([solid.means, solid.normals()], 1).T, rows)
        away = (places - own[:3].T) * own[3:].T
        across, beta = away.sum(1), solid.thinnest().mean()
        if given is None:
            apart, counts = across.abs(), torch.ones_like(rows, dtype=torch.bool)
        else:
            apart, counts = distances(given, places)
            counts &= apart <= REACH * solid.scales.detach().amax(1)[rows]
        if not counts.any():
            return 0 * beta
        amount, falls = density(gathered(solid.table(), near[rows]), places)
        amount = capped(amount)
        if self.mode == "density":
            error = (amount - torch.exp(-0.5 * (across / beta).square())).abs()
        else:
            error = (deviations(amount) - apart / beta.detach()).abs()
        turned = 2 - 2 * (normalize(falls, dim=1) * own[3:].T).sum(1).abs()
        return torch.where(counts, error + self.normals * turned, 0.0).sum() / counts.sum()

    def places(self, splats: Splats, rows: Tensor, seed: int) -> Tensor:
        """(M, 3) constant places, each drawn from the Gaussian of a row."""
        solid = Ellipsoids.of(splats.detached())
        draw = torch.randn(len(rows), 3, generator=torch.Generator().manual_seed(seed + 1))
        shift = self.spread * draw.to(solid.scales) * solid.scales[rows]
        return solid.means[rows] + (solid.axes[rows] @ shift[:, :, None])[:, :, 0]


def capped(amount: Tensor) -> Tensor:
    """Densities of at most 1: larger ones are scaled to 1 as they are, so that they keep a gradient."""
    return torch.where(amount > 1, amount / amount.detach().clamp_min(1.0), amount)


def deviations(amount: Tensor) -> Tensor:
    """sqrt(-2 ln d) of densities d in (0, 1]: the distance at which a Gaussian falls to d, in its sigmas."""
    square = -2 * amount.clamp_min(1e-10).log()
    apart = square > TINY
    return torch.where(apart, torch.where(apart, square, 1.0).sqrt(), 0.0)


def distances(given: RegularizerInput, places: Tensor) -> tuple[Tensor, Tensor]:
    """(M,) distances in depth of (M, 3) places from what is rendered of a view, and (M,) bool where there is any.

    The rendered surface is looked up in inverse depth, bilinearly, which is exact on planes.
    """
    camera = given.target.view.camera
    pose = camera.world_to_camera.to(places)
    local = (places @ pose[:3, :3].T + pose[:3, 3]).T
    depth = surface_depth(given.maps, "expected")
    there = depth > 0 if given.target.mask is None else (depth > 0) & given.target.mask
    inverse = torch.where(there, 1 / torch.where(there, depth, 1.0), 0.0)
    at = projected(camera, local)
    counts = (local[2] > 0) & is_whole(there, at)
    surface = 1 / torch.where(counts, sampled(inverse, at), 1.0)
    return torch.where(counts, (local[2] - surface).abs(), 0.0), counts
