"""What the views see of places in space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from surfkit.core.events import Progress, emit
from surfkit.mesh.base import MeshInput
from surfkit.primitives.drawing import PrimitiveRasterizer
from surfkit.raster.rays import ray_opacity

MAX_SEEN_OFFSET = 0.01
"""A vertex is seen where its depth is that of the picture, to this share of it."""


@dataclass(frozen=True)
class ViewOpacityField:
    """Which places lie in the open, by the opacity fields of the views (GOF).

    Attributes:
        subject: Splats and views.
        level: Opacity up to which a view sees a place in the open.
        agree: Share of the views looking at a place that must see it so, one at least. (GOF takes the view that sees
            it best, that is one; then a single wrong view cuts a hole.)
    """

    subject: MeshInput
    level: float
    agree: float

    def hidden(self, points: Tensor, what: str) -> tuple[Tensor, Tensor]:
        """(P,) bool, places that are inside of something, and (P,) the number of views that look; points are (P, 3).

        `what`: The work, for those who wait.
        """
        looking, open_to = (torch.zeros(len(points), dtype=torch.int32) for _ in range(2))
        given = self.subject
        for index, view in enumerate(given.views):
            opacity = given.rasterizer.opacity_before(given.splats, view.camera, given.near, points)
            looks = ~opacity.isnan()
            if (keep := given.keep(index)) is not None:
                looks &= shown(keep.float(), view.camera.project(points)) > 0.5
            looking += looks
            open_to += looks & (opacity <= self.level)
            emit(Progress(what, index + 1, len(given.views)))
        return open_to < (self.agree * looking).clamp_min(1), looking


def least_opacity(
    subject: MeshInput, points: Tensor, what: str, enough: float | None = None, solid: bool = False
) -> tuple[Tensor, Tensor]:
    """The opacity field (GOF): how much the splats hide of places from the view that sees them best.

    Gaussians hide in part what lies in them (`raster.rays`), unless they draw themselves; splats of other kinds hide as
    `Rasterizer.opacity_before` has it.

    Args:
        subject: Splats and views.
        points: (P, 3).
        what: The work, for those who wait.
        enough: No further view looks at a place that one has found to be hidden by no more than this, which saves most
            of the work where only the side of a level matters.
        solid: Whether Gaussians hide as stochastic solids (GGGS) instead of by their largest density.

    Returns:
        (P,) float32 in [0, 1], 1 where no view looks, and (P,) int32 how many views look; with `enough`, how many have
        looked so far.
    """
    splats, near = subject.splats, subject.near
    in_space = splats.kind == "gaussian" and not isinstance(subject.rasterizer, PrimitiveRasterizer)
    least, looking = torch.ones(len(points)), torch.zeros(len(points), dtype=torch.int32)
    for index, view in enumerate(subject.views):
        camera = view.camera
        x, y, z = camera.project(points).unbind(1)
        rows = (z > near) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
        if enough is not None:
            rows &= least > enough
        rows = rows.nonzero()[:, 0]
        if (keep := subject.keep(index)) is not None and len(rows):
            rows = rows[shown(keep.float(), camera.project(points[rows])) > 0.5]
        if len(rows):
            if in_space:
                found = ray_opacity(splats, camera, near, points[rows], solid)
            else:
                found = subject.rasterizer.opacity_before(splats, camera, near, points[rows])
            looks = ~found.isnan()
            least[rows] = torch.where(looks, torch.minimum(least[rows], found.float()), least[rows])
            looking[rows] += looks
        emit(Progress(what, index + 1, len(subject.views)))
    return least, looking


def shown(image: Tensor, places: Tensor) -> Tensor:
    """(P,) or (P, C) values of an (H, W) or (C, H, W) image at x and y of (P, 3) places, bilinear; 0 outside."""
    layers = image if image.ndim == 3 else image[None]
    size = torch.tensor([layers.shape[2], layers.shape[1]])
    grid = (places[:, :2] / size * 2 - 1).float()
    grid = torch.where((places[:, 2:] > 0) & grid.isfinite(), grid, 9.0)
    found = torch.nn.functional.grid_sample(layers[None], grid[None, None], align_corners=False)[0, :, 0].T
    return found if image.ndim == 3 else found[:, 0]


def vertex_colors(subject: MeshInput, vertices: np.ndarray) -> np.ndarray:
    """(V, 3) uint8 means over the views in which (V, 3) vertices are seen; grey where there is none."""
    points = torch.from_numpy(vertices).double()
    total, weight = torch.zeros(len(points), 3), torch.zeros(len(points), 1)
    for index, view in enumerate(subject.views):
        maps, places = subject.draw(view), view.camera.project(points)
        depth = shown(maps.need("median"), places)
        z = places[:, 2].float()
        # A far pixel says less of a place than a near one.
        seen = ((depth - z).abs() < MAX_SEEN_OFFSET * z) / z.square().clamp_min(1e-12)
        total += seen[:, None] * shown(maps.need("color"), places)
        weight += seen[:, None]
        emit(Progress("colouring", index + 1, len(subject.views)))
    mean = torch.where(weight > 0, total / weight.clamp_min(1e-12), 0.5)
    return (mean.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
