"""What the views see of places in space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from surfkit.core.events import Progress, emit
from surfkit.mesh.base import Subject

NEAR_SURFACE = 0.01
"""A vertex is seen where its depth is that of the picture, to this share of it."""


@dataclass(frozen=True)
class Field:
    """The opacity field of a subject: how much the splats hide of a place from the views that see it best.

    With one view to agree it is that of GOF, where a single wrong view cuts a hole.

    Attributes:
        subject: Splats and views.
        agree: The value is that of the view with so many-th lowest opacity, counted from 1.
    """

    subject: Subject
    agree: int

    def at(self, points: Tensor, what: str) -> tuple[Tensor, Tensor]:
        """(P,) opacity, 1 where too few views look, and (P,) the number of views that do; points are (P, 3).

        `what`: The work, for those who wait.
        """
        lowest = torch.ones(self.agree, len(points))
        views = torch.zeros(len(points), dtype=torch.int32)
        given = self.subject
        for index, view in enumerate(given.views):
            here = given.rasterizer.opacity_before(given.splats, view.camera, given.near, points).float()
            if (keep := given.keep(index)) is not None:
                here = torch.where(shown(keep.float(), view.camera.project(points)) > 0.5, here, torch.nan)
            views += ~here.isnan()
            here = here.nan_to_num(1.0)
            for rank in lowest:
                rank[:], here = torch.minimum(rank, here), torch.maximum(rank, here)
            emit(Progress(what, index + 1, len(given.views)))
        return lowest[-1], views


def shown(image: Tensor, places: Tensor) -> Tensor:
    """(P,) or (P, C) values of an (H, W) or (C, H, W) image at x and y of (P, 3) places, bilinear; 0 outside."""
    layers = image if image.ndim == 3 else image[None]
    size = torch.tensor([layers.shape[2], layers.shape[1]])
    grid = (places[:, :2] / size * 2 - 1).float()
    grid = torch.where((places[:, 2:] > 0) & grid.isfinite(), grid, 9.0)
    found = torch.nn.functional.grid_sample(layers[None], grid[None, None], align_corners=False)[0, :, 0].T
    return found if image.ndim == 3 else found[:, 0]


def vertex_colors(subject: Subject, vertices: np.ndarray) -> np.ndarray:
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
