"""What a pixel of the photographs shows of a surface: how large a cell of a map is, or a texel."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from surfkit.core.check import BadInput
from surfkit.evaluate.geometry.surface_file import SurfaceFile
from surfkit.scene.scene import Frame, View

SAMPLED_VERTICES = 50_000
"""Vertices that the depths are taken from."""


def pixel_sizes(surface: SurfaceFile, views: Sequence[View], frame: Frame) -> np.ndarray:
    """(V,) float64 side of a pixel of each view on the surface, units of the input; NaN where it shows none of it.

    That is the median depth of the vertices in the picture, whether hidden or not, divided by the focal length.
    """
    step = max(1, len(surface) // SAMPLED_VERTICES)
    xyz = surface.vertices(slice(None, None, step))
    points = torch.from_numpy(frame.to_local(xyz[np.isfinite(xyz).all(1)]))
    sizes = np.full(len(views), np.nan)
    for at, view in enumerate(views):
        camera = view.camera
        x, y, z = camera.project(points).T
        inside = (z > 0) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
        if inside.any():
            sizes[at] = float(z[inside].median()) / (camera.fx * camera.fy) ** 0.5 / frame.scale
    return sizes


def ground_sampling_distance(surface: SurfaceFile, views: Sequence[View], frame: Frame) -> float:
    """Side of a pixel on the surface, units of the input, rounded to two digits: the median over the views.

    Raises:
        BadInput: No view shows any of the surface.
    """
    sizes = pixel_sizes(surface, views, frame)
    if np.isnan(sizes).all():
        raise BadInput("--gsd auto: no photograph shows any of the mesh; give the size of a cell, such as --gsd 0.1")
    return float(f"{np.nanmedian(sizes):.2g}")
