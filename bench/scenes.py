"""The benchmark scene: 200,000 splats in front of one 800 x 608 camera, as many small as large, turned at random."""

from __future__ import annotations

import numpy as np
import torch

from surfkit.raster.api import Splats
from surfkit.scene.camera import Camera


def city(
    kind: str = "surfel", count: int = 200_000, width: int = 800, height: int = 608, seed: int = 0
) -> tuple[Splats, Camera]:
    """Splats between depth 2 and 12 with a median size of 3.6 px, opacity uniform in 0.05 to 0.95; and their camera."""
    rng = np.random.default_rng(seed)
    focal = 0.9 * width
    z = rng.uniform(2, 12, count)
    x = (rng.uniform(-0.05, 1.05, count) * width - width / 2) / focal * z
    y = (rng.uniform(-0.05, 1.05, count) * height - height / 2) / focal * z
    quats = rng.normal(size=(count, 4))
    scales = np.exp(rng.normal(np.log(0.010), 0.6, (count, 2 if kind == "surfel" else 3))) * z[:, None] * 0.5
    opacities = rng.uniform(0.05, 0.95, count)
    colors = rng.uniform(0, 1, (count, 3))
    dc = ((colors - 0.5) / 0.28209479177387814)[:, None]
    tensors = [torch.tensor(a, dtype=torch.float32) for a in (np.stack([x, y, z], 1), quats, scales, opacities, dc)]
    camera = Camera(torch.eye(4, dtype=torch.float64), focal, focal, width / 2, height / 2, width, height)
    return Splats(kind, *tensors), camera
