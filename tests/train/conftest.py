"""A scene small enough to train on in seconds, with photographs made by the rasterizer itself."""

from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

from surfkit.primitives import Surfel2D
from surfkit.raster.api import Splats
from surfkit.raster.base import Rasterizer
from surfkit.scene.camera import Camera
from surfkit.scene.scene import SparsePoints, View


@dataclass(frozen=True)
class Tiny:
    """Photographs of coloured discs on a plane, and a sparse cloud of their centres."""

    views: tuple[View, ...]
    photos: list[torch.Tensor]
    cloud: SparsePoints
    rasterizer: Rasterizer
    truth: Splats


def looking_down(x: float, y: float) -> Camera:
    """A camera at (x, y, 1) that looks along -z."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.diag(torch.tensor([1.0, -1.0, -1.0]))
    pose[:3, 3] = -pose[:3, :3] @ torch.tensor([x, y, 1.0], dtype=torch.float64)
    return Camera(pose, 30.0, 30.0, 14.0, 11.0, 28, 22)


@pytest.fixture(scope="session")
def tiny() -> Tiny:
    """See `Tiny`."""
    from surfkit.raster.select import select

    torch.set_num_threads(2)
    draw = torch.Generator().manual_seed(3)
    count = 40
    xy = torch.rand(count, 2, generator=draw) - 0.5
    means = torch.cat([xy, 0.05 * torch.rand(count, 1, generator=draw)], dim=1)
    colors = torch.rand(count, 3, generator=draw)
    truth = Splats(
        "surfel", means, torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1), torch.full((count, 2), 0.08),
        torch.full((count,), 0.9), ((colors - 0.5) / 0.28209479)[:, None],
    )  # fmt: skip
    rasterizer, _ = select("cpu")
    cameras = [looking_down(x, y) for x in (-0.2, 0.0, 0.2) for y in (-0.1, 0.1)]
    views = tuple(View(f"{i}.png", camera, Path(f"{i}.png")) for i, camera in enumerate(cameras))
    images = [rasterizer.render(truth, camera, 0.005, geometry=False).maps.color for camera in cameras]
    photos = [(image.clamp(0, 1) * 255).round().to(torch.uint8) for image in images]
    cloud = SparsePoints(means + 0.01 * torch.randn(count, 3, generator=draw), (colors * 255).to(torch.uint8))
    return Tiny(views, photos, cloud, rasterizer, truth)


@pytest.fixture
def begin(tiny):
    """A function from a stage to a trainer and its first state."""
    from surfkit.primitives.points import Points
    from surfkit.train.trainer import Trainer

    def start(stage, primitive=None, seed=0):
        primitive = primitive or Surfel2D(sh_degree=1)
        generator = torch.Generator().manual_seed(seed)
        points = Points.fresh(primitive.init(tiny.cloud, generator))
        trainer = Trainer(stage, primitive, tiny.views, tiny.photos, tiny.rasterizer)
        return trainer, trainer.begin(points, generator)

    return start
