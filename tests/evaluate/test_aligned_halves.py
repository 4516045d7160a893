import numpy as np
import pytest
import torch

from surfkit.evaluate.images.measure_images import aligned_halves, evaluate_views
from surfkit.raster.api import Maps
from surfkit.raster.psnr import psnr
from surfkit.scene.camera import Camera
from surfkit.scene.scene import View

VIEW = View("a.png", Camera(torch.eye(4, dtype=torch.float64), 30.0, 30.0, 15.0, 10.0, 31, 20), None)


@pytest.fixture
def pair():
    """A photograph, and the same with another exposure and white balance."""
    draw = torch.Generator().manual_seed(1)
    photo = 0.2 + 0.6 * torch.rand(3, 20, 31, generator=draw)
    change = torch.eye(3) * 0.7 + 0.1 * torch.rand(3, 3, generator=draw)
    return torch.einsum("ij,jhw->ihw", change, photo) + 0.02, photo


def test_a_change_of_light_is_taken_back(pair):
    render, photo = pair
    right, wanted, mask = aligned_halves(render, photo)
    assert right.shape == (3, 20, 16) and torch.equal(wanted, photo[:, :, 15:]) and mask is None
    assert psnr(right, wanted) > 80 > 30 > psnr(render, photo)


def test_it_is_the_least_squares_fit_to_the_left_half(pair):
    render, photo = pair[0] + 0.1 * torch.rand(3, 20, 31, generator=torch.Generator().manual_seed(2)), pair[1]
    left = np.column_stack([render[:, :, :15].flatten(1).T, np.ones(300)])
    change = np.linalg.lstsq(left, photo[:, :, :15].flatten(1).T.numpy(), rcond=None)[0]
    rest = np.column_stack([render[:, :, 15:].flatten(1).T, np.ones(320)]) @ change
    got = aligned_halves(render, photo)[0].flatten(1).T.numpy()
    assert np.abs(got - rest.clip(0, 1)).max() < 1e-5


def test_what_is_wrong_on_the_right_is_not_taken_back(pair):
    render, photo = pair
    wrong = torch.cat([render[:, :, :15], 0.5 * render[:, :, 15:]], 2)
    right, wanted, _ = aligned_halves(wrong, photo)
    assert psnr(right, wanted) < 15


def test_pixels_that_do_not_count_decide_nothing(pair):
    render, photo = pair
    mask = torch.rand(20, 31, generator=torch.Generator().manual_seed(3)) > 0.4
    right, wanted, kept = aligned_halves(torch.where(mask, render, 1), photo, mask)
    assert psnr(right, wanted, kept) > 80 > psnr(right, wanted)
    for half in (slice(None, 15), slice(15, None)):
        none = mask.clone()
        none[:, half] = False
        assert aligned_halves(render, photo, none) is None
    assert aligned_halves(render[:, :, :1], photo[:, :, :1]) is None


def test_both_kinds_are_measured(pair):
    render, photo = pair
    found = evaluate_views([VIEW], [(photo * 255).byte()], lambda _: Maps(color=render))["images"]
    assert found["psnr_aligned"] > 40 > found["psnr"] and found["ssim_aligned"] > 0.99 > found["ssim"]
    assert found["per_image"]["a.png"].keys() == {"psnr", "ssim", "psnr_aligned", "ssim_aligned"}
    none = torch.ones(20, 31, dtype=torch.bool)
    none[:, :15] = False
    masked = evaluate_views([VIEW], [(photo * 255).byte()], lambda _: Maps(color=render), masks=[none])["images"]
    assert masked["psnr_aligned"] is None and masked["psnr"] > 0
