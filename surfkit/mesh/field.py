"""What the views see of places in space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from surfkit.core.events import Progress, emit
from surfkit.mesh.base import MeshInput

NEAR_SURFACE = 0.01
"""A vertex is seen where its depth is that of the picture, to this share of it."""


@dataclass(frozen=True)
class Field:
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
        depth = shown(maps.median, places)
        z = places[:, 2].float()
        # A far pixel says less of a place than a near one.
        seen = ((depth - z).abs() < NEAR_SURFACE * z) / z.square().clamp_min(1e-12)
        total += seen[:, None] * shown(maps.color, places)
        weight += seen[:, None]
        emit(Progress("colouring", index + 1, len(subject.views)))
    mean = torch.where(weight > 0, total / weight.clamp_min(1e-12), 0.5)
    return (mean.clamp(0, 1) * 255).round().to(torch.uint8).numpy()
