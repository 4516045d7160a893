"""A picture of the blocks from above."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor

from surfkit.core.files import replacing
from surfkit.partition.base import CoarseModel
from surfkit.partition.plan import PartitionPlan

PLOT_SIDE_PX = 1000
"""Pixels of the longer side."""
BLOCK_COLORS = (
    (31, 119, 180),
    (255, 127, 14),
    (44, 160, 44),
    (214, 39, 40),
    (148, 103, 189),
    (140, 86, 75),
    (227, 119, 194),
)
SHOWN_POINT_SHARE = 0.99
"""Share of the points, along each axis, that decides what is in the picture."""
MAX_PLOTTED_POINTS = 200_000


def plan_picture(path: Path, sight: CoarseModel, plan: PartitionPlan) -> None:
    """Draw points in the colour of their block, cameras as rings, and the number of each block in the middle of it."""
    ground = plan.cells.ground
    points, cameras = ground.flat(sight.splats.means), ground.flat(sight.centres)
    low, high = _bounds(points, cameras)
    pixels = PLOT_SIDE_PX / float((high - low).max())
    width, height = (max(1, round(float(side) * pixels)) for side in high - low)
    owner = plan.cells.owner(sight.splats.means)
    every = max(1, len(points) // MAX_PLOTTED_POINTS)
    picture = np.full((height, width, 3), 255, np.uint8)
    at = ((points - low) * pixels).floor().long()[::every]
    inside = ((at >= 0) & (at < torch.tensor([width, height]))).all(1) & (owner[::every] >= 0)
    colors = np.array(BLOCK_COLORS, np.uint8)[owner[::every][inside].numpy() % len(BLOCK_COLORS)]
    picture[height - 1 - at[inside, 1].numpy(), at[inside, 0].numpy()] = colors
    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image)
    for x, y in ((cameras - low) * pixels).tolist():
        draw.ellipse([x - 3, height - y - 3, x + 3, height - y + 3], outline=(0, 0, 0))
    for block in plan.blocks:
        own = points[owner == block.index]
        if len(own):
            x, y = ((own.median(0).values - low) * pixels).tolist()
            draw.text(
                (x, height - y), f"{block.index}: {len(block.views)} views", fill=(0, 0, 0), anchor="mm", font_size=22
            )
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as part:
        image.save(part, format="PNG")


def _bounds(points: Tensor, cameras: Tensor) -> tuple[Tensor, Tensor]:
    """Lower and upper corner of what holds the cameras and nearly all points."""
    ranked = points.sort(0).values
    cut = int((1 - SHOWN_POINT_SHARE) / 2 * len(points))
    low = torch.minimum(ranked[cut], cameras.amin(0))
    high = torch.maximum(ranked[len(points) - 1 - cut], cameras.amax(0))
    margin = 0.03 * (high - low).max().clamp_min(1e-9)
    return low - margin, high + margin
