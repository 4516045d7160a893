"""A flat city of discs under a grid of cameras."""

import torch

from surfkit.partition import CoarseModel
from surfkit.partition.base import Ground
from surfkit.raster.api import Splats
from surfkit.raster.select import select
from surfkit.scene.camera import Camera
from surfkit.scene.scene import View

FLAT = Ground((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))


def below(x: float, y: float, height: float = 0.5) -> Camera:
    """A camera that looks straight down."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.tensor([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
    pose[:3, 3] = -pose[:3, :3] @ torch.tensor([x, y, height], dtype=torch.float64)
    return Camera(pose, 50.0, 50.0, 24.0, 20.0, 48, 40)


def city(count: int = 1_500, seed: int = 0) -> CoarseModel:
    """Discs on the ground, denser to the left, and 6 x 5 cameras above them."""
    draws = torch.Generator().manual_seed(seed)
    xy = torch.rand(count, 2, generator=draws) * 2 - 1
    xy[:, 0] = 2 * ((xy[:, 0] + 1) / 2) ** 2 - 1
    means = torch.cat([xy, 0.02 * torch.rand(count, 1, generator=draws)], 1)
    color = torch.rand(count, 1, 3, generator=draws) * 2 - 1
    quats = torch.tensor([1.0, 0, 0, 0]).expand(count, 4).contiguous()
    splats = Splats("surfel", means, quats, torch.full((count, 2), 0.025), torch.full((count,), 0.9), color)
    at = [(-0.8 + 1.6 * i / 5, -0.8 + 1.6 * j / 4) for j in range(5) for i in range(6)]
    views = tuple(View(f"{i:02}.png", below(*xy), path=None) for i, xy in enumerate(at))
    return CoarseModel(splats, views, select("cpu")[0], 0.01)
