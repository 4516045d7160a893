"""Flat Gaussians whose depth is that of their planes (PGSR, Chen et al. 2024, section on unbiased depth)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from surfkit.plugin import (
    SH_C0,
    Camera,
    Column,
    Columns,
    DerivedRender,
    Gaussian3D,
    Gradients,
    Maps,
    Primitive,
    Rasterizer,
    Render,
    SparsePoints,
    Splats,
    rotated,
)

OPAQUE = 0.5
"""Alpha from which a pixel has a median depth, as for the rasterizers' own."""
STEEPEST = 0.01
"""Blended normals at a smaller cosine to the ray give no depth."""
FAINTEST = 1e-4
"""Nor do pixels of a lower alpha."""


@dataclass(frozen=True)
class PlanarGaussian(Primitive):
    """Ellipsoids that are pressed flat by a loss, and drawn with the depth of their planes (PGSR, arXiv 2406.06521).

    The normals and the distances of the planes from the camera are blended, and the depth is where the ray meets the
    blended plane. Both depths, expected and median, are this one. Add regularizers.KEY:mean-thickness to press them
    flat. Drawing depth takes one more render, of the distances.
    """

    antialias: bool = False
    """Dim splats smaller than a pixel by what the 0.3 px blur adds to them."""

    @property
    def _ellipsoids(self) -> Gaussian3D:
        return Gaussian3D(self.sh_degree, self.antialias)

    def columns(self) -> Mapping[str, Column]:
        """Those of ellipsoids."""
        return self._ellipsoids.columns()

    def init(self, cloud: SparsePoints, generator: torch.Generator) -> Columns:
        """Balls."""
        return self._ellipsoids.init(cloud, generator)

    def activate(self, params: Columns, degree: int) -> Splats:
        """Ellipsoids."""
        return self._ellipsoids.activate(params, degree)

    def render(
        self,
        splats: Splats,
        camera: Camera,
        rasterizer: Rasterizer,
        near: float,
        geometry: bool = True,
        distortion: bool = True,
    ) -> Render:
        """See `Primitive.render`."""
        if not geometry:
            return rasterizer.render(splats, camera, near, False, distortion)
        return PlaneRender(splats, camera, rasterizer, near, distortion)


def plane_distances(splats: Splats, camera: Camera) -> Tensor:
    """(N,) distances of the planes of ellipsoids from a camera, 0 or more; differentiable.

    A plane goes through the centre, across the shortest axis.
    """
    pose = camera.world_to_camera.to(splats.means)
    axis = torch.nn.functional.one_hot(splats.scales.argmin(1), 3).to(splats.means)
    normals = rotated(axis, splats.quats)
    offsets = splats.means + pose[:3, :3].T @ pose[:3, 3]  # from the camera, in the world's axes
    return (normals * offsets).sum(1).abs()


def plane_depth(alpha: Tensor, normal: Tensor, distance: Tensor, camera: Camera) -> Tensor:
    """(H, W) camera z of the blended planes, distance / -(normal . ray); 0 where there is none. Differentiable.

    Args:
        alpha: (H, W) only decides where there is a depth.
        normal: (3, H, W) sum of w_i n_i, camera frame, towards the camera.
        distance: (H, W) sum of w_i d_i, distances of the planes.
        camera: Of the maps.
    """
    rays = camera.rays(normal.dtype).to(normal.device)
    along = -(normal * rays).sum(0)
    length = (normal.detach().square().sum(0) * rays.square().sum(0)).sqrt()
    there = (alpha.detach() > FAINTEST) & (along.detach() > STEEPEST * length) & (distance.detach() > 0)
    return torch.where(there, distance / torch.where(there, along, 1.0), 0.0)


class PlaneRender(Render):
    """A view whose depth and median are those of the blended planes.

    Of absolute pixel gradients, those by the distances and by all other maps are added up, each without its signs.
    """

    def __init__(
        self, splats: Splats, camera: Camera, rasterizer: Rasterizer, near: float, distortion: bool = True
    ) -> None:
        """Draw.

        Args:
            splats: Ellipsoids.
            camera: Of the view.
            rasterizer: Draws the maps, and then the distances as if they were colours.
            near: See `Rasterizer.render`.
            distortion: Whether to draw it too.
        """

        def with_distances(given: Splats) -> tuple[Splats, Tensor]:
            color = (plane_distances(given, camera)[:, None, None] - 0.5) / SH_C0
            return given.with_colors(color.expand(-1, -1, 3)), torch.arange(len(given), device=color.device)

        self._camera = camera
        self._all = rasterizer.render(splats, camera, near, True, distortion)
        self._far = DerivedRender(
            splats, camera, with_distances, lambda made: rasterizer.render(made, camera, near, False)
        )
        self.seen, self.radii = self._all.seen, self._all.radii
        drawn = self._all.maps
        depth, median = self._depths(drawn.need("alpha"), drawn.need("normal"), self._far.maps.need("color")[0])
        self.maps = replace(drawn, depth=depth, median=median)

    def _depths(self, alpha: Tensor, normal: Tensor, distance: Tensor) -> tuple[Tensor, Tensor]:
        """The maps `depth`, which alpha divides to the expected one, and `median`."""
        depth = plane_depth(alpha, normal, distance, self._camera)
        return alpha * depth, torch.where(alpha.detach() > OPAQUE, depth, 0.0)

    def backward(
        self, total: Maps, chosen: Maps | None = None, absolute: bool = False, rows: int | None = None
    ) -> Gradients:
        """See `Render.backward`."""
        direct, far = self._taken_apart(total)
        part, far_part = (None, None) if chosen is None else self._taken_apart(chosen)
        found = self._all.backward(direct, part, absolute, rows)
        if far is None and far_part is None:
            return found
        blank = Maps(color=torch.zeros_like(self.maps.need("color")))
        other = self._far.backward(far or blank, None if chosen is None else far_part or blank, absolute, rows)
        return _added(found, other)

    def _taken_apart(self, cotangents: Maps) -> tuple[Maps, Maps | None]:
        """Cotangents of the maps that are drawn directly, and of the distances as colours; None if there are none."""
        given = cotangents.present()
        wanted = [given.pop(name, None) for name in ("depth", "median")]
        if all(value is None for value in wanted):
            return cotangents, None
        drawn = self.maps.need("alpha"), self.maps.need("normal"), self._far.maps.need("color")[0]
        leaves = [t.detach().requires_grad_() for t in drawn]
        with torch.enable_grad():
            made = self._depths(*leaves)
        pairs = [(map, value) for map, value in zip(made, wanted, strict=True) if value is not None]
        alpha, normal, distance = torch.autograd.grad(
            [map for map, _ in pairs], leaves, [value.to(map) for map, value in pairs], allow_unused=True
        )
        for name, value in (("alpha", alpha), ("normal", normal)):
            if value is not None:
                given[name] = given[name] + value if name in given else value
        color = torch.zeros_like(self.maps.need("color"))
        color[0] = distance
        return Maps(**given), Maps(color=color)


def _added(one: Gradients, other: Gradients) -> Gradients:
    """The sum of two gradients by the same splats."""
    summed: dict[str, Any] = {name: value + other.tensors()[name] for name, value in one.tensors().items()}
    chosen = None if one.chosen is None or other.chosen is None else one.chosen + other.chosen
    return replace(one, **summed, signal=one.signal + other.signal, chosen=chosen)
