"""GSDF (Yu et al., NeurIPS 2024): a splat branch and a branch of a signed distance, which

1. samples its rays where the splats have their depth ("depth-guided ray sampling"),
2. decides where splats grow and which are pruned ("geometry-aware density control", density.py),
3. agrees with the splats on depth and normals ("mutual geometry supervision").

Both branches look at the same pixels of the photograph whose turn it is for the splats.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import torch
from surfkit_neus.batches import Batch
from surfkit_neus.box import Rays, camera_rays
from surfkit_neus.method import Neuralangelo
from surfkit_neus.render import Drawn, Samples, draw_along
from surfkit_neus.sampling import even_samples
from surfkit_octree.anchors import Anchors
from surfkit_octree.growth import AnchorGrowth
from surfkit_octree.volume import AnchorVolume
from torch import Tensor
from torch.nn.functional import normalize

from surfkit.plugin import (
    L1,
    SSIM,
    BadInput,
    CompletedStep,
    LearningRate,
    Loss,
    Maps,
    MethodInput,
    Stage,
    Steps,
    Target,
    name_of,
    require_within,
)
from surfkit_sdf_splats.branches import Link, Surface, counted
from surfkit_sdf_splats.density import NearSurface
from surfkit_sdf_splats.method import SplatsWithDistance

SOLID = 0.5
"""Pixels and rays with less alpha than this say nothing of where the surface is."""


def guided_range(rays: Rays, t: Tensor, sdf: Tensor, reach: float, narrowest: float) -> tuple[Tensor, Tensor]:
    """(R,) distances between which rays are sampled, [D - k |s|, D + k |s|], cut to the box; the whole box for rays on
    which D is unknown or outside it.

    Args:
        rays: R rays.
        t: (R,) D, the distance at which the splats are; 0 where unknown.
        sdf: (R,) s, the signed distance there.
        reach: k.
        narrowest: What k |s| is at least, in units of the box: without any width, nothing would have a gradient.
    """
    half = (reach * sdf.abs()).clamp_min(narrowest)
    known = (t > rays.near) & (t < rays.far)
    near, far = torch.maximum(t - half, rays.near), torch.minimum(t + half, rays.far)
    return torch.where(known, near, rays.near), torch.where(known, far, rays.far)


@dataclass(frozen=True)
class Shape:
    """Where R rays end: distances and normals in the frame of the box.

    Attributes:
        t: (R,) distance along the ray.
        normal: (R, 3) unit vectors.
        solid: (R,) bool, whether they are known.
    """

    t: Tensor
    normal: Tensor
    solid: Tensor

    def detached(self) -> Shape:
        """The same values, constant."""
        return Shape(self.t.detach(), self.normal.detach(), self.solid)


def mutual(one: Shape, other: Shape, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Mean |D - D'| and mean 1 - n . n' over the rays on which both know a surface, by a weight (R,)."""
    rows = weight * one.solid * other.solid
    return counted(rows, (one.t - other.t).abs()), counted(rows, 1 - (one.normal * other.normal).sum(1))


def splat_shape(maps: Maps, rays: Rays, pixels: Tensor, turn: Tensor) -> Shape:
    """What splats show in pixels (R,), with the graph to the maps; `turn` takes the frame of the camera to the box."""
    alpha = maps.need("alpha").flatten()[pixels]
    depth = maps.need("depth").flatten()[pixels] / alpha.clamp_min(1e-6)
    normal = normalize(maps.need("normal").flatten(1)[:, pixels].T @ turn.to(alpha), dim=1)
    solid = (alpha.detach() > SOLID) & (depth.detach() > 0)
    return Shape(depth / rays.depth.to(alpha), normal, solid)


def field_shape(drawn: Drawn, rays: Rays) -> Shape:
    """What the distance shows on rays, with the graph to its field; nothing on those that miss the box."""
    t, alpha = drawn.distance / drawn.alpha.clamp_min(1e-3), drawn.alpha.detach()
    return Shape(t, normalize(drawn.normal, dim=1), (alpha > SOLID) & (rays.far > rays.near))


@dataclass
class SharedPixels(Link):
    """Both branches at the same pixels of a view."""

    method: GSDF
    surface: Surface
    shared: dict[str, Tensor] = field(default_factory=dict)

    def tied(self, stage: Stage) -> Stage:
        """See `Link.tied`."""
        assert stage.densify is not None, "the method refuses it"
        method, surface = self.method, self.surface
        control = NearSurface(stage.densify, surface.distances, method.sigma, method.grow, method.prune, surface.alone)
        return replace(stage, losses=stage.losses | {"mutual": Mutual(self)}, densify=control)

    def losses(self, done: CompletedStep) -> dict[str, Tensor]:
        """See `Link.losses`: those that were found when the splats were compared with it."""
        return self.shared

    def look(self, maps: Maps, target: Target) -> Tensor:
        """Scalar: how far the splats are from the surface in some pixels. The other half, with all losses of the
        surface, is kept for `losses`.

        Args:
            maps: Of the splats.
            target: The view.
        """
        method, surface, index = self.method, self.surface, self.surface.index
        batch, pixels = self.batch(target)
        turn = target.view.camera.world_to_camera[:3, :3] @ surface.box.axes.T
        rays = batch.rays
        splats = splat_shape(maps, rays, pixels.to(maps.need("alpha").device), turn)
        with torch.enable_grad():
            drawn = self.drawn(rays, splats)
            found = field_shape(drawn, rays)
            losses = surface.settings.losses(surface.state.field, drawn, batch, index)
            there = Shape(*(value.detach().to(surface.device) for value in (splats.t, splats.normal, splats.solid)))
            weights = method.mutual_at(index)
            terms = mutual(found, there, batch.weight)
            self.shared = losses | {
                name: weight * term for name, weight, term in zip(("depth", "normal"), weights, terms, strict=True)
            }
        device = splats.t.device
        known = Shape(*(value.detach().to(device) for value in (found.t, found.normal, found.solid)))
        depth, normal = mutual(splats, known, batch.weight.to(device))
        return weights[0] * depth + weights[1] * normal

    def batch(self, target: Target) -> tuple[Batch, Tensor]:
        """Pixels of a view, on the device of the surface, and (R,) their numbers."""
        surface, camera = self.surface, target.view.camera
        draw = surface.batches.draw(surface.index)
        pixels = torch.randint(camera.width * camera.height, (surface.settings.rays,), generator=draw)
        at = pixels.to(target.photo.device)
        color = target.photo.flatten(1)[:, at].T
        weight = torch.ones_like(color[:, 0]) if target.mask is None else target.mask.flatten()[at].to(color)
        depth = confidence = torch.zeros_like(weight)
        if (prior := target.prior) is not None:
            inverse, confidence = prior.inverse.flatten()[at], prior.confidence.flatten()[at]
            depth = torch.where(inverse > 0, 1 / inverse.clamp_min(1e-9), 0.0)
        points = surface.batches.points
        chosen = points[torch.randint(max(1, len(points)), (len(pixels),), generator=draw)] if len(points) else points
        device = surface.device
        values = (color, weight, depth, confidence, chosen)
        rays = camera_rays(camera, surface.box, pixels).to(device)
        return Batch(rays, *(value.detach().to(device) for value in values)), pixels

    def drawn(self, rays: Rays, splats: Shape) -> Drawn:
        """The surface on rays, sampled around where the splats are once that is due."""
        method, surface, state = self.method, self.surface, self.surface.state
        draw = surface.batches.draw(surface.index + surface.settings.steps)  # not that of the pixels
        near, far = rays.near, rays.far
        if surface.index > method.guided:
            t = torch.where(splats.solid, splats.t.detach(), 0.0).to(surface.device)
            with torch.no_grad():
                look = surface.settings.look(surface.index)
                sdf = state.field(rays.at(t[:, None])[:, 0], look.levels)[0]
            near, far = guided_range(rays, t, sdf, method.reach, method.narrowest)
        samples = surface.settings.samples
        t = even_samples(near, far, samples.even, draw)
        return draw_along(state.field, state.background, rays, t, samples, surface.settings.look(surface.index), draw)


@dataclass(frozen=True)
class Mutual(Loss):
    """What the surface makes of depth and normals of the splats, from its first step on."""

    reads: ClassVar[tuple[str, ...]] = ("color", "alpha", "depth", "normal")
    link: SharedPixels

    def weight_at(self, index: int, steps: int) -> float:
        """See `Loss.weight_at`."""
        return float(index > self.link.surface.alone)

    def __call__(self, maps: Maps, target: Target) -> Tensor:
        """See `Loss.__call__`."""
        return self.link.look(maps, target)


def _splats() -> Stage:
    """Scaffold-GS, as the paper has it; anchors grow for 15,000 steps more, which the surface then guides."""
    return Stage(
        steps=45_000,
        losses={"l1": L1(), "ssim": SSIM()},
        regularizers={"volume": AnchorVolume()},
        densify=AnchorGrowth(until=30_000),
        rates={"opacities": LearningRate(0.0)},
    )


@dataclass(frozen=True)
class GSDF(SplatsWithDistance):
    """Splats and a neural signed distance that guide each other's samples, density, depth and normals (GSDF, Yu et
    al. 2024)."""

    splats: Stage = field(default_factory=_splats)
    """Optimisation of the splats. Its steps are those of the whole run."""

    surface: Neuralangelo = Neuralangelo(
        steps=30_000, photos=1, samples=Samples(even=16, surface=16, rounds=1, beyond=8)
    )
    """The signed distance. Its steps are the last ones of the run; before them, the splats are optimised alone. Its
    rays are pixels of the one photograph that is shown to the splats."""

    guided: Steps = 5_000
    """Steps of the surface before its rays are sampled around the depth of the splats, instead of through the box."""

    reach: float = 3.0
    """k: rays are sampled from k |s| before to k |s| behind the depth of the splats, s being the distance there."""

    narrowest: float = 0.02
    """What k |s| is at least, as a share of half the longest side of the scene box."""

    depth: float = 0.01
    """Weight of the difference of depths, in units of half the longest side of the scene box, for both branches."""

    normal: float = 0.01
    """Weight of the difference of normals, for both branches."""

    drop: Steps = 15_000
    """Steps of the surface after which both weights fall to a tenth."""

    sigma: float = 0.07
    """Width of mu(s) = exp(-s^2 / (2 sigma^2)), as a share of half the longest side of the scene box."""

    grow: float = 1.5e-4
    """Weight of mu(s), which is added to the gradients by which splats grow."""

    prune: float = 0.01
    """Weight of 1 - mu(s), which is taken from the opacities by which splats are pruned."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_within({"reach": (1e-3, 1e3), "narrowest": (1e-6, 2), "sigma": (1e-6, 1e3)}, self)
        require_within({"guided": (0, 2**31), "drop": (0, 2**31)}, self)
        require_within(dict.fromkeys(("depth", "normal", "grow", "prune"), (0, 1e6)), self)
        if self.surface.photos != 1:
            raise BadInput(
                f"surface.photos is {self.surface.photos}; it must be 1, as rays are those of the photograph that is "
                "shown to the splats"
            )
        if self.splats.densify is None:
            raise BadInput("splats.densify is none, and the surface controls the density of splats; choose one")
        if "mutual" in self.splats.losses:
            raise BadInput("splats.losses.mutual: the name is that of the method's own loss; choose another")

    def refuse_unfit(self, given: MethodInput) -> None:
        """See `Method.refuse_unfit`."""
        primitive = given.used["primitive"]
        if isinstance(self.splats.densify, AnchorGrowth) and not isinstance(primitive, Anchors):
            raise BadInput(
                f"method.splats.densify: anchor-growth adds anchors only, and the primitive is {name_of(primitive)}; "
                "choose method.splats.densify:adc with method.splats.regularizers.volume:none, or primitive:anchors"
            )
        super().refuse_unfit(given)

    def mutual_at(self, index: int) -> tuple[float, float]:
        """Weights of depth and normals in step `index` of the surface."""
        share = 0.1 if index > self.drop else 1.0
        return share * self.depth, share * self.normal

    def link(self, surface: Surface) -> SharedPixels:
        """See `SplatsWithDistance.link`."""
        return SharedPixels(self, surface)
