"""Volume rendering of rays through the field and what lies beyond its box."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from surfkit.plugin import Maps, View, require_within
from surfkit_neus.box import Rays, SceneBox, camera_rays
from surfkit_neus.field import BackgroundField, SurfaceField
from surfkit_neus.gradients import Geometry, analytic, numerical
from surfkit_neus.sampling import beyond_samples, even_samples, surface_samples
from surfkit_neus.weights import section_alphas, section_ends, weights_of


@dataclass(frozen=True)
class Samples:
    """How many positions of a ray are looked at."""

    even: int = 16
    """Evenly, from where a ray enters the scene box to where it leaves it."""

    surface: int = 16
    """Near the surface, by importance."""

    rounds: int = 2
    """Rounds in which those are found, each with a sharper density."""

    beyond: int = 8
    """Beyond the box."""

    def __post_init__(self) -> None:
        require_within({"even": (2, 4096), "surface": (0, 4096), "rounds": (1, 16), "beyond": (1, 4096)}, self)

    @property
    def in_all(self) -> int:
        """Of a ray."""
        return self.even + self.surface + self.beyond


@dataclass(frozen=True)
class Look:
    """How the field is evaluated in a step of the schedule.

    Attributes:
        levels: Levels of the hash grid that are used; None for all.
        step: Of numerical gradients, in lengths of the box; None for analytic ones.
        anneal: See `weights.section_ends`.
    """

    levels: int | None = None
    step: float | None = None
    anneal: float = 1.0

    def geometry(self, field: SurfaceField, x: Tensor) -> Geometry:
        """The field at (P, 3) positions."""
        return analytic(field, x, self.levels) if self.step is None else numerical(field, x, self.step, self.levels)


@dataclass(frozen=True)
class Drawn:
    """R rays with N sections each.

    Attributes:
        color: (R, 3), with what lies beyond the box.
        alpha: (R,) of what lies in the box.
        distance: (R,) sum of weights times distances along the ray.
        median: (R,) distance of the section behind which less than half of the light comes from; 0 where more does.
        normal: (R, 3) sum of weights times normals, frame of the box.
        geometry: At the R x N middles of the sections.
        inside: (R x N,) bool, whether the ray crosses the box there.
    """

    color: Tensor
    alpha: Tensor
    distance: Tensor
    median: Tensor
    normal: Tensor
    geometry: Geometry
    inside: Tensor


def draw_rays(
    field: SurfaceField,
    background: BackgroundField,
    rays: Rays,
    samples: Samples,
    look: Look,
    draw: torch.Generator | None = None,
) -> Drawn:
    """Render rays; samples are moved at random if `draw`."""
    t = even_samples(rays.near, rays.far, samples.even, draw)
    return draw_along(field, background, rays, t, samples, look, draw)


def draw_along(
    field: SurfaceField,
    background: BackgroundField,
    rays: Rays,
    t: Tensor,
    samples: Samples,
    look: Look,
    draw: torch.Generator | None = None,
) -> Drawn:
    """Render rays between given distances (R, N), sorted, to which `samples.surface` are added."""

    def distances(t: Tensor) -> Tensor:
        return field(rays.at(t).flatten(0, 1), look.levels)[0].view_as(t)

    t = surface_samples(t, distances, samples.surface, samples.rounds)
    middle, length = 0.5 * (t[:, 1:] + t[:, :-1]), t.diff(dim=1)
    x, view = rays.at(middle).flatten(0, 1), _each(rays.direction, middle.shape[1])
    geometry = look.geometry(field, x)
    slope = (geometry.gradient * view).sum(1).view_as(middle)
    front, back = section_ends(geometry.sdf.view_as(middle), slope, length, look.anneal)
    weights, left = weights_of(section_alphas(front, back, field.sharpness))
    shades = field.color(x, geometry.normal, view, geometry.features).view(*middle.shape, 3)
    color = (weights[:, :, None] * shades).sum(1) + left[:, None] * _beyond(background, rays, samples.beyond, draw)
    return Drawn(
        color=color,
        alpha=1 - left,
        distance=(weights * middle).sum(1),
        median=_median(weights.detach(), middle),
        normal=(weights[:, :, None] * geometry.normal.view(*middle.shape, 3)).sum(1),
        geometry=geometry,
        inside=(rays.far > rays.near)[:, None].expand_as(middle).flatten(),
    )


def _beyond(background: BackgroundField, rays: Rays, count: int, draw: torch.Generator | None) -> Tensor:
    """(R, 3) colour of what is seen behind the box."""
    t = beyond_samples(rays.far, count, draw)
    middle = 0.5 * (t[:, 1:] + t[:, :-1])
    density, shades = background(rays.at(middle).flatten(0, 1), _each(rays.direction, count))
    weights, left = weights_of(-torch.expm1(-density.view_as(middle) * t.diff(dim=1)))
    return (weights[:, :, None] * shades.view(*middle.shape, 3)).sum(1) + left[:, None] * background.last


def _each(values: Tensor, count: int) -> Tensor:
    """(R x count, 3) of (R, 3): one for each sample."""
    return values[:, None].expand(-1, count, -1).flatten(0, 1)


def _median(weights: Tensor, t: Tensor) -> Tensor:
    total = weights.cumsum(1)
    at = (total < 0.5).sum(1, keepdim=True).clamp_max(t.shape[1] - 1)
    return torch.where(total[:, -1] >= 0.5, t.gather(1, at)[:, 0], 0.0)


@torch.no_grad()
def draw_view(
    draw_some: Callable[[Rays], Drawn], view: View, box: SceneBox, device: torch.device, rays_at_once: int
) -> Maps:
    """Maps of a view, on the CPU; see `Maps`."""
    height, width = view.camera.height, view.camera.width
    parts: list[tuple[Tensor, ...]] = []
    for pixels in torch.arange(height * width).split(rays_at_once):
        rays = camera_rays(view.camera, box, pixels).to(device)
        drawn = draw_some(rays)
        depth = torch.stack([drawn.distance, drawn.median], 1) * rays.depth[:, None]
        parts.append(tuple(value.cpu() for value in (drawn.color, drawn.alpha, depth, drawn.normal)))
    color, alpha, depth, normal = (torch.cat(values) for values in zip(*parts, strict=True))
    turn = (view.camera.world_to_camera[:3, :3] @ box.axes.T).float()

    def image(values: Tensor) -> Tensor:
        return values.T.reshape(-1, height, width).contiguous()

    return Maps(
        color=image(color),
        alpha=image(alpha[:, None])[0],
        depth=image(depth)[0],
        median=image(depth)[1],
        normal=image(normal @ turn.T),
    )
