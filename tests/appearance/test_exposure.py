import pytest
import torch

from surfkit.appearance import Exposure
from surfkit.core.check import BadInput
from surfkit.primitives.surfel2d import Surfel2D
from surfkit.raster.projection import colors
from surfkit.scene.camera import Camera
from surfkit.scene.scene import SparsePoints

CAMERA = Camera(torch.eye(4, dtype=torch.float64), 30.0, 30.0, 8.0, 8.0, 16, 16)


def test_it_begins_by_changing_nothing():
    color = torch.rand(3, 4, 5)
    assert torch.equal(Exposure()(Exposure().begin(3)[1], color, CAMERA), color)


def test_it_is_the_matrix_and_the_offset():
    numbers = torch.arange(12.0).view(3, 4) / 10
    color = torch.rand(3, 2, 2)
    expected = numbers[:, :3] @ color[:, 1, 0] + numbers[:, 3]
    assert torch.allclose(Exposure()(numbers, color, CAMERA)[:, 1, 0], expected)


def test_folded_points_have_the_colours_of_the_mean_photograph():
    draw = torch.Generator().manual_seed(0)
    cloud = SparsePoints(
        torch.rand(30, 3, generator=draw), torch.randint(60, 200, (30, 3), generator=draw, dtype=torch.uint8)
    )
    primitive = Surfel2D(sh_degree=2)
    params = primitive.init(cloud, draw)
    params["sh_rest"] = 0.02 * torch.randn(params["sh_rest"].shape, generator=draw)
    numbers = torch.eye(3, 4) + 0.1 * torch.rand(4, 3, 4, generator=draw)
    pose = torch.eye(4, dtype=torch.float64)
    camera = Camera(pose, 30.0, 30.0, 8.0, 8.0, 16, 16)
    before, after = (
        colors(primitive.activate(p, 2), camera) for p in (params, Exposure().folded(numbers, params))
    )  # fmt: skip
    expected = Exposure()(numbers.mean(0), before.T[:, :, None], CAMERA)[:, :, 0].T
    assert before.min() > 0 and torch.allclose(after, expected, atol=1e-5)


def test_the_rate_falls_evenly_in_the_logarithm():
    assert Exposure().rate_at(1_000, 1_000) == pytest.approx(1e-3)
    assert Exposure().rate_at(500, 1_000) == pytest.approx((1e-2 * 1e-3) ** 0.5)
    with pytest.raises(BadInput, match="0.0"):
        Exposure(end=0.0)
