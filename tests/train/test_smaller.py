"""Steps that look at photographs of a half or a quarter of their size."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from surfkit.core.check import BadInput
from surfkit.io.datasets.data import Data
from surfkit.io.datasets.depth_prior import DepthPrior
from surfkit.losses import L1, SSIM, Reprojection
from surfkit.losses.base import Target
from surfkit.primitives import Surfel2D
from surfkit.primitives.points import Points
from surfkit.raster.select import select
from surfkit.runs.folder import Run
from surfkit.runs.warn import warn_of_sizes
from surfkit.scene.camera import Camera
from surfkit.scene.scene import SparsePoints, View
from surfkit.study.recipes import RECIPES
from surfkit.testing.synthetic import Flight, photograph
from surfkit.train import checkpoint
from surfkit.train.smaller import divisor_for, smaller, smaller_camera
from surfkit.train.stage import Stage
from surfkit.train.trainer import Trainer

CAMERA = Camera(torch.eye(4, dtype=torch.float64), 150.0, 140.0, 70.0, 60.0, 143, 130)


def target(inverse=None, **more) -> Target:
    photo = torch.rand(3, 130, 143, generator=torch.Generator().manual_seed(0))
    prior = None if inverse is None else DepthPrior(inverse, torch.ones_like(inverse), 1.0)
    return Target(View("a.png", CAMERA, Path("a.png")), photo, prior, **more)


def plane() -> torch.Tensor:
    """(130, 143) inverse depth of a slope, by the rays of the camera."""
    x, y, _ = CAMERA.rays(torch.float64)
    return (0.2 + 0.05 * x - 0.07 * y).float()


@pytest.mark.parametrize("divisor", [2, 4])
def test_a_place_falls_into_the_block_of_its_pixel(divisor):
    points = torch.randn(200, 3, generator=torch.Generator().manual_seed(1)).double() + torch.tensor([0.0, 0, 5])
    small = smaller_camera(CAMERA, divisor)
    assert (small.width, small.height) == (143 // divisor, 130 // divisor)
    assert torch.allclose(small.project(points)[:, :2] * divisor, CAMERA.project(points)[:, :2])


@pytest.mark.parametrize("divisor", [2, 4])
def test_a_block_has_the_mean_colour_of_its_pixels(divisor):
    given = target()
    small, (high, wide) = smaller(given, divisor), (130 // divisor, 143 // divisor)
    blocks = given.photo.numpy()[:, : high * divisor, : wide * divisor].reshape(3, high, divisor, wide, divisor)
    assert np.allclose(small.photo.numpy(), blocks.mean((2, 4)), atol=1e-6)
    assert small.view.name == "a.png" and small.view.camera == smaller_camera(CAMERA, divisor)
    assert smaller(given, 1) is given


@pytest.mark.parametrize("divisor", [2, 4])
def test_the_depth_of_a_plane_is_that_of_the_middle_of_a_block(divisor):
    small = smaller(target(plane()), divisor)
    x, y, _ = small.view.camera.rays(torch.float64)
    assert torch.allclose(small.prior.inverse.double(), 0.2 + 0.05 * x - 0.07 * y, atol=1e-6)
    assert bool((small.prior.confidence == 1).all()) and small.prior.normal is None


def test_nothing_is_known_of_a_block_at_an_edge_or_with_a_pixel_of_which_nothing_is():
    inverse = plane()
    inverse[:, 41:] *= 2  # an edge within the blocks 20 of 2 pixels, 10 of 4
    inverse[10, 100] = 0
    for divisor, edge, hole in ((2, 20, (5, 50)), (4, 10, (2, 25))):
        known = smaller(target(inverse), divisor).prior.inverse > 0
        expected = torch.ones_like(known)
        expected[:, edge], expected[hole] = False, False
        assert torch.equal(known, expected)
        assert torch.equal(smaller(target(inverse), divisor).prior.confidence > 0, expected)


def test_a_block_counts_with_the_colour_of_three_quarters_of_its_pixels():
    mask = torch.ones(130, 143, dtype=torch.bool)
    mask[4:6, 8:10], mask[4:6, 12:14], mask[6, 12] = False, False, False  # 12 and 11 of 16 are left
    given = target(mask=mask)
    small = smaller(given, 4)
    assert (~small.mask).nonzero().tolist() == [[1, 3]]
    for column in (2, 3):
        columns = slice(4 * column, 4 * column + 4)
        inside = given.photo.numpy()[:, 4:8, columns][:, mask[4:8, columns].numpy()]
        assert np.allclose(small.photo[:, 1, column].numpy(), inside.mean(1), atol=1e-6)
    none = smaller(target(mask=torch.zeros_like(mask)), 4)
    assert not none.mask.any() and torch.isfinite(none.photo).all()


def test_normals_stay_of_length_one():
    normal = torch.nn.functional.normalize(torch.randn(3, 130, 143, generator=torch.Generator().manual_seed(2)), dim=0)
    normal[:, 21, 33] = 0
    given = target(plane())
    small = smaller(replace(given, prior=replace(given.prior, normal=normal)), 4)
    lengths = small.prior.normal.norm(dim=0)
    assert (lengths == 0).nonzero().tolist() == [[5, 8]] and torch.allclose(lengths[lengths > 0], torch.tensor(1.0))
    mean = normal[:, 4:8, 12:16].mean((1, 2))
    assert torch.allclose(small.prior.normal[:, 1, 3], mean / mean.norm(), atol=1e-6)


def test_small_photographs_are_not_made_smaller():
    assert [divisor_for(replace(CAMERA, width=w, height=130), 4) for w in (143, 127, 64, 63, 20)] == [4, 2, 2, 1, 1]


def started(losses, quarter: int, half: int) -> tuple[Trainer, object]:
    """Surfels on a synthetic scene, photographs of 144 x 128 px."""
    made = photograph(Flight(views=20, width=144, height=128, test_every=0))
    views, xyz, rgb, normals = made.scene.train, [], [], []
    photos = [(made.exact[view.name].color * 255).round().to(torch.uint8) for view in views]
    for view in views[::4]:
        truth, pose = made.exact[view.name], view.camera.world_to_camera
        there = (truth.depth > 0) & (torch.rand(128, 144, generator=torch.Generator().manual_seed(0)) < 0.1)
        xyz.append((pose[:3, :3].T @ ((view.camera.rays(torch.float64) * truth.depth)[:, there] - pose[:3, 3:])).T)
        normals.append((pose[:3, :3].T @ truth.normal[:, there]).T)
        rgb.append((truth.color[:, there].T * 255).to(torch.uint8))
    cloud = SparsePoints(torch.cat(xyz).float(), torch.cat(rgb), torch.cat(normals).float())
    primitive, generator = Surfel2D(sh_degree=0), torch.Generator().manual_seed(3)
    stage = Stage(steps=8, losses=losses, densify=None, quarter_until=quarter, half_until=half)
    trainer = Trainer(stage, primitive, views, photos, select("cpu")[0])
    params = primitive.init(cloud, generator)
    params["opacities"].fill_(2.0)
    return trainer, trainer.begin(Points.fresh(params), generator)


PAIRED = {"l1": L1(), "ssim": SSIM(), "reprojection": Reprojection(start=0, every=1)}


def test_steps_have_the_sizes_of_the_schedule_and_a_run_that_goes_on_has_the_same_bits(tmp_path):
    trainer, state = started(PAIRED, 3, 6)
    whole = list(trainer.run(state))
    sizes = [(done.target.view.camera.width, *done.maps.need("color").shape[1:]) for done in whole]
    assert sizes == [(36, 32, 36)] * 3 + [(72, 64, 72)] * 3 + [(144, 128, 144)] * 2
    assert all(done.losses["reprojection"] > 0 for done in whole)
    other, halfway = started(PAIRED, 3, 6)
    for done in other.run(halfway):
        if done.index == 2:
            break
    checkpoint.save(tmp_path / "state.safetensors", halfway)
    again = checkpoint.load(tmp_path / "state.safetensors")
    assert [done.losses for done in other.run(again)] == [done.losses for done in whole[2:]]


@pytest.mark.parametrize(
    ("quarter", "half", "size", "text"),
    [
        (4, 0, (64, 48), "48 px are too few to halve"),
        (4, 2, (128, 96), "pretrain.half_until 2 does nothing"),
        (2, 4, (128, 96), None),
        (0, 0, (64, 48), None),
    ],
)
def test_a_schedule_that_does_nothing_is_told(warned, tmp_path, quarter, half, size, text):
    scene = photograph(Flight(views=2, width=size[0], height=size[1], test_every=0)).scene
    recipe = replace(RECIPES["2dgs"], pretrain=Stage(steps=8, quarter_until=quarter, half_until=half))
    warn_of_sizes(Run(tmp_path, recipe, Data(tmp_path)), scene)
    assert len(warned) == (text is not None) and all(text in each for each in warned)


def test_a_negative_number_of_steps_is_refused():
    with pytest.raises(BadInput, match="half_until is -1"):
        Stage(half_until=-1)
